// Types of report.json, the report of a registration. Made by scripts/make_api_types.py; do not edit.

export interface Accuracy {
  n: number;
  bias_m: (number | null)[];
  std_m: (number | null)[];
  rmse_m: (number | null)[];
  ce90_m: Quantile;
  le90_m: Quantile | null;
}

export interface Acquisition {
  image_id: string;
  sensor: string;
  acquired_at: string | null;
  incidence_deg: number | null;
  azimuth_deg: number | null;
  sun_elevation_deg: number | null;
  sun_azimuth_deg: number | null;
}

export interface AdjustmentOptions {
  order: "shift" | "drift" | "affine" | null;
  tolerance: number | null;
  min_points: number;
  points_per_parameter: number | null;
  min_spread: number | null;
  min_gain: number | null;
  folds: number;
  prior_slope_sigma_px: number | null;
  profile: boolean;
  bends: boolean;
}

export interface BlockUsed {
  id: string;
  version: string;
  visible: number | null;
  active: number | null;
  sigma_m: number | null;
}

export interface Candidate {
  points: number;
  east_m: number | null;
  north_m: number | null;
  false_alarms: number | null;
}

export interface CellStability {
  cells: number;
  left_out: number;
  failed: number;
  displacements: Displacement[];
  held_out_px: ImageResiduals;
  held_out_m: ImageResiduals;
  group_means: GroupMeans;
  note: string;
}

export interface Check {
  against: string;
  accuracy: Accuracy;
  image_residuals_px: ImageResiduals | null;
  normalised: NormalisedError | null;
}

export interface CoarseOptions {
  max_fine_radius_px: number;
  points: number;
  enough: number;
  min_score: number | null;
  max_search_px: number;
  max_reduction: number;
  max_false_alarms: number | null;
}

export interface CorrectionRecord {
  order: string;
  order_reason: string;
  order_scores: OrderScore[];
  parameters_px: Numbers[];
  std_px: Numbers[];
  centre_px: Numbers[];
  half_size_px: Numbers[];
  shift_px: Numbers[];
  shift_m: number | null;
  words: string[];
  sigma0: number | null;
  local_sigma_px: Numbers[];
}

export interface CorrelationOptions {
  min_score: number | null;
  max_second: number | null;
  second_distance_px: number;
  min_contrast: number | null;
  max_sigma_px: number | null;
  max_missing_share: number | null;
}

export interface Coverage {
  cells: Numbers[];
  percent: number | null;
  reach_px: number | null;
  outline: Numbers[][];
  polygons_lon_lat: Numbers[][][];
}

export interface Criterion {
  name: string;
  label: string;
  value: number | null;
  comparison: "at least" | "at most";
  limit: number | null;
  unit: string;
  decimals: number;
  needed_for: "good" | "usable";
  met: boolean;
  calculation: string;
  note: string;
}

export interface Displacement {
  place: string;
  median_px: number | null;
  max_px: number | null;
  median_m: number | null;
  max_m: number | null;
}

export interface DrawnDisplacement {
  place: string;
  median_px: number | null;
  max_px: number | null;
  median_m: number | null;
  max_m: number | null;
  x_m: number | null;
  y_m: number | null;
}

export interface Finding {
  name: string;
  harm_px: Numbers[];
  words: string;
}

export interface GroundResiduals {
  east: Statistics;
  north: Statistics;
  horizontal: Statistics;
}

export interface GroupMeans {
  rms_px: number | null;
  over_independent: number | null;
  over_stated: number | null;
}

export interface ImageResiduals {
  x: Statistics;
  y: Statistics;
  xy: Statistics;
}

export interface MarkResult {
  point: number;
  name: string;
  line: number | null;
  sample: number | null;
  lon: number | null;
  lat: number | null;
  height_m: number | null;
  sigma_px: number | null;
  sigma_m: Numbers[];
  residual_px: Numbers[];
  left_out_px: Numbers[];
  left_out_sigma_px: Numbers[];
  status: "used" | "rejected" | "in doubt";
  note: string;
}

export interface MarksReport {
  marks: MarkResult[];
  prior_shift_px: number | null;
  prior_slope_px: number | null;
  held: string[];
  next_mark: NextMark;
  words: string[];
}

export interface MatchingOptions {
  max_views: number;
  agreement_px: number | null;
  min_gradient_score: number | null;
  view_distance: ViewDistanceScales;
  correlation: CorrelationOptions;
}

export interface NextMark {
  line: number | null;
  sample: number | null;
  lon: number | null;
  lat: number | null;
  ce90_px: number | null;
  ce90_m: number | null;
}

export interface NormalisedError {
  mean_square: number | null;
  lower: number | null;
  upper: number | null;
  n: number;
  confidence: number | null;
}

export interface NotFound {
  reason: string;
  count: number;
}

export type Numbers = number | null | Numbers[];

export interface OrderScore {
  order: string;
  left_out_px: number | null;
}

export interface PixelFinding {
  kind: "repeated lines" | "repeated samples" | "lost lines" | "lost samples" | "enlarged by nearest neighbour" | "odd lines displaced" | "odd samples displaced" | "bands displaced" | "second image" | "part of another image";
  line: number;
  sample: number;
  lines: number;
  samples: number;
  amount_px: number | null;
  evidence: number | null;
  words: string;
}

export interface PointCounts {
  visible: number;
  not_tried: number;
  matched: number;
  active: number;
  active_of_matched: number | null;
  active_of_visible: number | null;
}

export interface PredictedAccuracy {
  std_line_px: Numbers[];
  std_sample_px: Numbers[];
  ce90_px: Numbers[];
  worst_px: number | null;
  overall_px: number | null;
  worst_m: number | null;
  overall_m: number | null;
  on_the_earth_worst_m: number | null;
  on_the_earth_overall_m: number | null;
}

export interface QualificationOptions {
  good_active_points: number;
  good_coverage_percent: number | null;
  good_active_of_matched: number | null;
  good_residual_std_px: number | null;
  good_displacement_px: number | null;
  good_displacement_m: number | null;
  good_ce90_px: number | null;
  good_ce90_m: number | null;
  max_ce90_on_earth_m: number | null | null;
  good_unit_weight: number | null;
  good_second_consensus_share: number | null;
  usable_active_points: number;
  usable_active_of_few: number | null;
  usable_residual_std_px: number | null;
  usable_displacement_px: number | null;
  usable_displacement_m: number | null;
  usable_ce90_px: number | null;
  usable_ce90_m: number | null;
  coverage_cells: number;
  grid: number;
  draws: number;
  kept_share: number | null;
}

export interface Quantile {
  value: number | null;
  lower: number | null;
  upper: number | null;
  n: number;
  probability: number | null;
  confidence: number | null;
  note: string;
}

export interface ReasonCount {
  stage: "not matched" | "deactivated";
  reason: string;
  label: string;
  count: number;
}

export interface ReferenceMatchingOptions {
  window_px: number;
  correlation: CorrelationOptions;
}

export interface ReferenceOptions {
  places: number;
  leading_places: number;
  first_radius_px: number;
  fine_stages: number;
  settled_px: number | null;
  enough: number;
  max_false_alarms: number | null;
  matching: ReferenceMatchingOptions;
}

export interface RefinedModelRecord {
  max_error_px: number | null;
  note: string;
}

export interface RegistrationOptions {
  max_points: number;
  fine_stages: number;
  seed: number;
  coarse: CoarseOptions;
  matching: MatchingOptions;
  adjustment: AdjustmentOptions;
  qualification: QualificationOptions;
  reference: ReferenceOptions;
}

export interface Report {
  format: "amers-registration-report/4";
  run: RunRecord;
  verdict: "good" | "usable" | "failed";
  verdict_scope: string;
  verdict_explanation: string;
  relative_to_control_points: StatedAccuracy;
  on_the_earth: StatedAccuracy;
  criteria: Criterion[];
  scene: SceneRecord;
  correction: CorrectionRecord;
  refined_model: RefinedModelRecord;
  search_stages: SearchStage[];
  point_counts: PointCounts;
  reasons: ReasonCount[];
  image_residuals_px: ImageResiduals;
  ground_residuals_m: GroundResiduals;
  stability: Stability;
  cell_stability: CellStability;
  predicted: PredictedAccuracy;
  coverage: Coverage;
  findings: Finding[];
  checks: Check[];
  marks: MarksReport | null;
}

export interface RunRecord {
  software_version: string;
  started_at: string | null;
  finished_at: string | null;
  method: "control points" | "reference image";
  blocks: BlockUsed[];
  options: RegistrationOptions;
  statements: Statement[];
}

export interface SceneRecord {
  name: string;
  acquisition: Acquisition;
  lines: number;
  samples: number;
  gsd_m: number | null;
  model: string;
  sigma_m: number | null;
  footprint_lon_lat: Numbers[];
  pixel_findings: PixelFinding[];
}

export interface SearchStage {
  name: string;
  chip_gsd_m: number | null;
  search_radius_m: number | null;
  needed_radius_m: number | null;
  tried: number;
  matched: number;
  at_border: number;
  inliers: number;
  displacement_rms_m: number | null;
  not_found: NotFound[];
  candidates: Candidate[];
  middle_m: number | null;
}

export interface Stability {
  kept_share: number | null;
  draws: number;
  failed_draws: number;
  held_out_per_draw: number;
  displacements: DrawnDisplacement[];
  held_out_px: ImageResiduals;
  held_out_m: ImageResiduals;
  group_means: GroupMeans;
  note: string;
}

export interface StatedAccuracy {
  label: string;
  ce90_m: number | null;
  le90_m: number | null;
  words: string;
}

export interface Statement {
  file: string;
  subject: "sensor model" | "place in the full image" | "pixel origin" | "horizontal datum" | "vertical datum" | "unit" | "epoch" | "order of values" | "valid pixels" | "bands" | "identity" | "accuracy";
  use: "used" | "assumed" | "not used";
  value: string;
  where: string;
  note: string;
  more_files: number;
  is_usual: boolean;
}

export interface Statistics {
  n: number;
  mean: number | null;
  std: number | null;
  rms: number | null;
}

export interface ViewDistanceScales {
  direction_deg: number | null;
  season_days: number | null;
  sun_elevation_deg: number | null;
  sun_azimuth_deg: number | null;
  sensor: number | null;
  health: number | null;
}
