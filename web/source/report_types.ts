// Types of report.json, the report of a registration. Made by scripts/make_api_types.py; do not edit.

/** Errors of points against something better. */
export interface Accuracy {
  /** points. */
  n: number;
  /** east, north and, when known, up. */
  bias_m: (number | null)[];
  /** east, north and, when known, up. */
  std_m: (number | null)[];
  /** east, north and, when known, up. */
  rmse_m: (number | null)[];
  /** of the horizontal distance. */
  ce90_m: Quantile;
  /** of the height error without its sign; None when heights were not compared. */
  le90_m: Quantile | null;
}

/** Sensor, time and geometry of the acquisition of an image. */
export interface Acquisition {
  /** name of the image, unique within a block. */
  image_id: string;
  /** platform or instrument, "" when unknown. */
  sensor: string;
  /** UTC, None when unknown. */
  acquired_at: string | null;
  /** angle at the ground between the vertical and the line of sight of the image centre; NaN when unknown. */
  incidence_deg: number | null;
  /** direction from the ground to the sensor, clockwise from north; NaN when unknown. */
  azimuth_deg: number | null;
  /** at the centre of the image; NaN when unknown. */
  sun_elevation_deg: number | null;
  /** at the centre of the image; NaN when unknown. */
  sun_azimuth_deg: number | null;
}

/** How a scene is adjusted. */
export interface AdjustmentOptions {
  /** of the correction; None selects it by cross-validation. Drift and skew are then estimated whatever the order, as far as the measures determine them. */
  order: "shift" | "drift" | "affine" | null;
  /** a measure is deactivated when its residual exceeds this many standard deviations. */
  tolerance: number | null;
  /** smallest number of active measures. */
  min_points: number;
  /** measures for each parameter that an order needs to be considered. */
  points_per_parameter: number | null;
  /** spread of the measures that an order beyond the shift needs: standard deviation along each axis, in half sizes of the image (an even spread has 0.58). */
  min_spread: number | null;
  /** an order replaces a simpler one when it reduces the cross-validated residual by this fraction. */
  min_gain: number | null;
  /** of the cross-validation. */
  folds: number;
  /** a priori standard deviation of drift and skew at the edge of the image, pixels; the measures may raise it, never lower it. */
  prior_slope_sigma_px: number | null;
  /** the same where the order is given; None leaves drift and skew to the measures. */
  slope_px: number | null | null;
}

/** A block whose points were used. */
export interface BlockUsed {
  /** of the block. */
  id: string;
  /** of the block. */
  version: string;
}

/** Accuracy at points that had no part in the registration. */
export interface Check {
  /** what the points are, for people. */
  against: string;
  /** of the registered model; a single scene gives no heights, hence no LE90. */
  accuracy: Accuracy;
  /** of the marks; x along samples, y along lines; null when there are no marks. */
  image_residuals_px: ImageResiduals | null;
  /** the residuals in units of the stated precision of model, marks and points; null when unknown. */
  normalised: NormalisedError | null;
}

/** Options of the coarse search: few points, far out. */
export interface CoarseOptions {
  /** a search radius up to this many pixels of the fine chips needs no coarse search. */
  max_fine_radius_px: number;
  /** number of points to try that the scene is expected to show whole, wherever it lies. */
  points: number;
  /** number of chips of one ground sampling that the scene should show whole for that ground sampling to be used. */
  enough: number;
  /** normalised correlation below which a chip is not found; the consensus of many points decides which of these matches are right. */
  min_score: number | null;
  /** largest search radius, pixels; to search further, the chips are reduced. */
  max_search_px: number;
  /** largest reduction of a chip; below 25 pixels a chip is hardly distinctive. */
  max_reduction: number;
  /** a consensus with more expected false alarms than this is refused. */
  max_false_alarms: number | null;
}

/** The correction of the model: from image positions by the delivered model to true positions. */
export interface CorrectionRecord {
  /** "shift", "drift" or "affine". */
  order: string;
  /** the order and why it was chosen, as a sentence. */
  order_reason: string;
  /** of the orders that were compared. */
  order_scores: OrderScore[];
  /** rows line and sample; constant, along lines, along samples (at the image's edge). */
  parameters_px: Numbers[];
  /** one standard deviation of each parameter. */
  std_px: Numbers[];
  /** line and sample that the parameters refer to. */
  centre_px: Numbers[];
  /** line and sample that the parameters refer to. */
  half_size_px: Numbers[];
  /** displacement at the centre, line and sample. */
  shift_px: Numbers[];
  /** length of that displacement on the ground, by the ground sampling of the image. */
  shift_m: number | null;
  /** the parameters as sentences. */
  words: string[];
  /** a posteriori standard deviation of unit weight. */
  sigma0: number | null;
}

/** When a correlation peak is accepted. */
export interface CorrelationOptions {
  /** smallest normalised correlation of a chip that is found (SRP's published example). */
  min_score: number | null;
  /** largest ratio of the second peak to the first; above it the position is ambiguous. */
  max_second: number | null;
  /** smallest distance between the first and the second peak. */
  second_distance_px: number;
  /** smallest standard deviation over mean; below it a chip is flat. */
  min_contrast: number | null;
  /** largest sigma along any direction, chip pixels; above it the position is ambiguous. */
  max_sigma_px: number | null;
}

/** Share of equal cells of the image that hold an active point. */
export interface Coverage {
  /** (c, c) active points in each cell, rows from the first line down. */
  cells: Numbers[];
  /** cells with a point. */
  occupied: number;
  /** 0 to 100. */
  percent: number | null;
}

/** A figure of a registration, compared with its limit. */
export interface Criterion {
  /** identifier of the criterion. */
  name: string;
  /** name of the criterion for people. */
  label: string;
  /** the figure; NaN when it could not be computed. */
  value: number | null;
  /** "at least" or "at most". */
  comparison: "at least" | "at most";
  /** the threshold, in the unit of the value. */
  limit: number | null;
  /** of value and limit, "" for counts and ratios. */
  unit: string;
  /** digits after the point that are worth showing. */
  decimals: number;
  /** "good" or "usable": the best verdict that is impossible without this criterion. */
  needed_for: "good" | "usable";
  /** whether the value meets the limit; a value that could not be computed never does. */
  met: boolean;
  /** how the value is calculated, for people. */
  calculation: string;
}

/** Displacement of one place of the image between the full solution and solutions with fewer points. */
export interface Displacement {
  /** "top left", "top right", "bottom right", "bottom left" or "centre". */
  place: string;
  /** length, over the draws. */
  median_px: number | null;
  /** length, over the draws. */
  max_px: number | null;
  /** length, over the draws. */
  median_m: number | null;
  /** length, over the draws. */
  max_m: number | null;
  /** along samples and lines in the first draw: one repeated adjustment, as in the published tables. */
  x_m: number | null;
  /** along samples and lines in the first draw: one repeated adjustment, as in the published tables. */
  y_m: number | null;
}

/** Residuals of the active points on the ground, metres; a single scene gives no heights. */
export interface GroundResiduals {
  /** in the horizontal plane through the point. */
  east: Statistics;
  /** in the horizontal plane through the point. */
  north: Statistics;
  /** length of the residual. */
  horizontal: Statistics;
}

/** Residuals of the active points in the image, pixels. */
export interface ImageResiduals {
  /** along samples. */
  x: Statistics;
  /** along lines. */
  y: Statistics;
  /** length of the residual. */
  xy: Statistics;
}

/** How control points are matched. */
export interface MatchingOptions {
  /** largest number of views of a point that are tried. */
  max_views: number;
  /** largest distance between measures of one point by several views that agree, pixels of the chips as they are searched. */
  agreement_px: number | null;
  /** smallest correlation of gradients that is accepted for a point whose grey values do not correlate. */
  min_gradient_score: number | null;
  /** differences between a view and the scene that decide which views are tried. */
  view_distance: ViewDistanceScales;
  /** acceptance of correlation peaks. With a `min_score` of 0.6, 215 of 216 peaks in four simulated scenes were right; the agreement of views and points rejects others. */
  correlation: CorrelationOptions;
}

/** Mean square of errors in units of their stated precision; 1 when the precision is honest. */
export interface NormalisedError {
  /** above 1, errors are larger than stated; below 1, smaller. */
  mean_square: number | null;
  /** where it lies, with the given confidence, when errors are as large as stated. */
  lower: number | null;
  /** where it lies, with the given confidence, when errors are as large as stated. */
  upper: number | null;
  /** rows. */
  n: number;
  /** of the interval. */
  confidence: number | null;
}

/** A number, null where it is unknown, or rows of them. */
export type Numbers = number | null | Numbers[];

/** How well an order of the correction predicts points that it was not fitted to. */
export interface OrderScore {
  /** "shift", "drift" or "affine". */
  order: string;
  /** distance of the points left out of the fit from their predicted positions, rms, pixels. */
  left_out_px: number | null;
}

/** Numbers of points at the stages of a registration. */
export interface PointCounts {
  /** points that the scene could show (published as Popini). */
  visible: number;
  /** visible points that were not searched, because well-spread others represent them. */
  not_tried: number;
  /** points that were found, and whose views agree (published as Spatio). */
  matched: number;
  /** points that the final adjustment uses (published as Actif). */
  active: number;
  /** ratios, 0 to 1; NaN when the divisor is zero. */
  active_of_matched: number | null;
  /** ratios, 0 to 1; NaN when the divisor is zero. */
  active_of_visible: number | null;
}

/** Accuracy all over the image, predicted by the covariance of the correction. */
export interface PredictedAccuracy {
  /** (g, g) on a regular grid from corner to corner. */
  std_line_px: Numbers[];
  /** (g, g) on a regular grid from corner to corner. */
  std_sample_px: Numbers[];
  /** (g, g) by the normal law. */
  ce90_px: Numbers[];
  /** of `ce90_px` over the image. */
  worst_px: number | null;
  /** of `ce90_px` over the image. */
  median_px: number | null;
  /** of `ce90_px` over the image. */
  worst_m: number | null;
  /** of `ce90_px` over the image. */
  median_m: number | null;
  /** of the frame of the points' blocks, by the circular normal law; NaN when unknown. */
  frame_ce90_m: number | null;
}

/** Thresholds and sampling of a qualification. */
export interface QualificationOptions {
  /** smallest number of active points (SRP: one measure is never enough, at least 20). */
  good_active_points: number;
  /** smallest coverage of the image by active points. */
  good_coverage_percent: number | null;
  /** smallest ratio of active to matched points. */
  good_active_of_matched: number | null;
  /** largest standard deviation of the active residuals, of the worse coordinate, without the part that chance and the stated accuracy of the points explain. */
  good_residual_std_px: number | null;
  /** largest displacement of a corner or the centre when a part of the points is held out: the worst place, the median over the draws. */
  good_displacement_px: number | null;
  /** the limits of displacement and CE90 as shares of the CE90 of the points, where these allow more than the limits in pixels. Points coarser than the pixels still make a model several times better than they are (SRP: corners within 0.3 m with points of 3 m). */
  good_displacement_of_points: number | null;
  /** largest predicted CE90 of the correction over the image. */
  good_ce90_px: number | null;
  /** the limits of displacement and CE90 as shares of the CE90 of the points, where these allow more than the limits in pixels. Points coarser than the pixels still make a model several times better than they are (SRP: corners within 0.3 m with points of 3 m). */
  good_ce90_of_points: number | null;
  /** largest standard deviation of unit weight: residuals over the stated sigmas. */
  good_unit_weight: number | null;
  /** largest group of deactivated points that agree on another displacement, as a share of the active points. A scene has one displacement, not two. */
  good_second_consensus_share: number | null;
  /** smallest number of active points. */
  usable_active_points: number;
  /** largest standard deviation of the active residuals, of the worse coordinate, without the part that chance and the stated accuracy of the points explain. */
  usable_residual_std_px: number | null;
  /** largest displacement of a corner or the centre when a part of the points is held out: the worst place, the median over the draws. */
  usable_displacement_px: number | null;
  /** the limits of displacement and CE90 as shares of the CE90 of the points, where these allow more than the limits in pixels. Points coarser than the pixels still make a model several times better than they are (SRP: corners within 0.3 m with points of 3 m). */
  usable_displacement_of_points: number | null;
  /** largest predicted CE90 of the correction over the image. */
  usable_ce90_px: number | null;
  /** the limits of displacement and CE90 as shares of the CE90 of the points, where these allow more than the limits in pixels. Points coarser than the pixels still make a model several times better than they are (SRP: corners within 0.3 m with points of 3 m). */
  usable_ce90_of_points: number | null;
  /** cells of the coverage along each side of the image. */
  coverage_cells: number;
  /** nodes of the predicted accuracy along each side of the image. */
  grid: number;
  /** number of repeated adjustments in the stability test. */
  draws: number;
  /** share of the active points in each draw. */
  kept_share: number | null;
}

/** A quantile of a sample with a confidence interval that assumes no law. */
export interface Quantile {
  /** estimate; NaN without a sample. */
  value: number | null;
  /** bounds of the true quantile, order statistics of the sample; NaN where the sample is too small to bound it on that side. */
  lower: number | null;
  /** bounds of the true quantile, order statistics of the sample; NaN where the sample is too small to bound it on that side. */
  upper: number | null;
  /** size of the sample. */
  n: number;
  /** which quantile, 0.9 for CE90 and LE90. */
  probability: number | null;
  /** of the interval; the true one is at least this. */
  confidence: number | null;
  /** what a small sample does not allow to say; "" when there is nothing to add. */
  note: string;
}

/** Number of points that are not active for one reason. */
export interface ReasonCount {
  /** "not matched", or "deactivated" after a match. */
  stage: "not matched" | "deactivated";
  /** code given by the matching or the adjustment. */
  reason: string;
  /** what the code means, for people. */
  label: string;
  /** number of points. */
  count: number;
}

/** How places are matched on a reference. */
export interface ReferenceMatchingOptions {
  /** side of the window of the reference that is correlated, pixels of the level; odd. */
  window_px: number;
  /** when a correlation peak is accepted. */
  correlation: CorrelationOptions;
}

/** Options of a registration on a reference ortho-image. */
export interface ReferenceOptions {
  /** number of places searched at the finest level, evenly over the scene. */
  places: number;
  /** number of places searched at the coarser levels; where less than a quarter of them agree, `places` are searched. */
  leading_places: number;
  /** the first level is so coarse that three standard deviations of the model are at most this many of its pixels. */
  first_radius_px: number;
  /** largest number of searches at the finest level, each through the last model. */
  fine_stages: number;
  /** a search at the finest level that moves every corner of the image by at most this many pixels of the level is the last. */
  settled_px: number | null;
  /** smallest number of whole windows that the scene must hold at a level. */
  enough: number;
  /** a first consensus with more expected false alarms than this is refused. */
  max_false_alarms: number | null;
  /** how places are searched. */
  matching: ReferenceMatchingOptions;
}

/** The files of the refined model. */
export interface RefinedModelRecord {
  /** largest difference between the corrected model and the model in the files; 0 when they carry the correction exactly, null when no model was written. */
  max_error_px: number | null;
  /** which files carry the correction, and how well, as a sentence. */
  note: string;
}

/** Options of a registration, on control points or on a reference image. */
export interface RegistrationOptions {
  /** largest number of points tried, well spread over the image; 0 tries all points. */
  max_points: number;
  /** number of searches with the fine chips, each through the last model. */
  fine_stages: number;
  /** of the random draws of the stability test. */
  seed: number;
  /** of the coarse search. */
  coarse: CoarseOptions;
  /** how points are searched. */
  matching: MatchingOptions;
  /** of the correction. */
  adjustment: AdjustmentOptions;
  /** thresholds of the verdict. */
  qualification: QualificationOptions;
  /** of a registration on a reference image. */
  reference: ReferenceOptions;
}

/** The report of one registration. */
export interface Report {
  /** of the document, with its version. */
  format: "amers-registration-report/2";
  /** how and when the registration was run. */
  run: RunRecord;
  /** "good", "usable" or "failed"; follows from the criteria alone. */
  verdict: "good" | "usable" | "failed";
  /** what the verdict means, for people. */
  verdict_explanation: string;
  /** every figure that has a limit. */
  criteria: Criterion[];
  /** what was registered. */
  scene: SceneRecord;
  /** of the model of the scene. */
  correction: CorrectionRecord;
  /** the files that carry the correction. */
  refined_model: RefinedModelRecord;
  /** the searches of the points, in order. */
  search_stages: SearchStage[];
  /** points visible, matched and active. */
  point_counts: PointCounts;
  /** why points are not active, commonest first. */
  reasons: ReasonCount[];
  /** of the active points; x along samples, y along lines. */
  image_residuals_px: ImageResiduals;
  /** of the active points; no heights, which a single scene does not give. */
  ground_residuals_m: GroundResiduals;
  /** the adjustment repeated without a part of its points; not absolute accuracy. */
  stability: Stability;
  /** accuracy by the covariance of the correction. */
  predicted: PredictedAccuracy;
  /** of the image by active points. */
  coverage: Coverage;
  /** accuracy at points that had no part in the registration. */
  checks: Check[];
}

/** How and when a registration was run. */
export interface RunRecord {
  /** of Amers. */
  software_version: string;
  /** UTC; None when unknown. */
  started_at: string | null;
  /** UTC; None when unknown. */
  finished_at: string | null;
  /** whether on control points or on a reference image. */
  method: "control points" | "reference image";
  /** the blocks whose points were used, or the reference image. */
  blocks: BlockUsed[];
  /** of the registration. */
  options: RegistrationOptions;
}

/** The scene that was registered. */
export interface SceneRecord {
  /** for people. */
  name: string;
  /** how it was taken. */
  acquisition: Acquisition;
  /** size of the image, pixels. */
  lines: number;
  /** size of the image, pixels. */
  samples: number;
  /** ground sampling at the centre, metres. */
  gsd_m: number | null;
  /** kind of the delivered model, such as "RPC". */
  model: string;
  /** accuracy of the model before registration, one standard deviation a coordinate, metres. */
  sigma_m: number | null;
  /** outline on the ground, degrees, not closed. */
  footprint_lon_lat: Numbers[];
}

/** Summary of one search of the points through one model. */
export interface SearchStage {
  /** "coarse" or "fine" on control points, "reference" on a reference image. */
  name: string;
  /** ground sampling of the chips that were searched. */
  chip_gsd_m: number | null;
  /** search radius on the ground. */
  search_radius_m: number | null;
  /** numbers of points searched, found, and in agreement with each other. */
  tried: number;
  /** numbers of points searched, found, and in agreement with each other. */
  matched: number;
  /** numbers of points searched, found, and in agreement with each other. */
  inliers: number;
  /** distance of the inliers from their expected positions, root mean square. */
  displacement_rms_m: number | null;
}

/** The adjustment repeated without a part of its points. It shows stability, not absolute accuracy. */
export interface Stability {
  /** share of the active points in each draw. */
  kept_share: number | null;
  /** number of adjustments that succeeded. */
  draws: number;
  /** number of adjustments that gave no solution. */
  failed_draws: number;
  /** number of points held out of each draw. */
  held_out_per_draw: number;
  /** of the four corners and the centre; empty when no draw succeeded. */
  displacements: Displacement[];
  /** residuals of the points held out, all draws together; a point counts once in each draw that it was held out of. */
  held_out_px: ImageResiduals;
  /** the same on the ground, by the ground sampling of the image. */
  held_out_m: ImageResiduals;
  /** why there is no figure; "" otherwise. */
  note: string;
}

/** Moments of one coordinate. */
export interface Statistics {
  /** finite values. */
  n: number;
  /** NaN without values. */
  mean: number | null;
  /** about the mean, n - 1 in the denominator; NaN below two values. */
  std: number | null;
  /** about zero. */
  rms: number | null;
}

/** Differences between a view and a scene that have equal weight. */
export interface ViewDistanceScales {
  /** angle between the lines of sight. */
  direction_deg: number | null;
  /** difference of the days of the year. */
  season_days: number | null;
  /** differences of the direction of the sun. */
  sun_elevation_deg: number | null;
  /** differences of the direction of the sun. */
  sun_azimuth_deg: number | null;
  /** distance of a view by another sensor. */
  sensor: number | null;
  /** loss of health; see `types.health`. */
  health: number | null;
}
