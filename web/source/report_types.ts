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

/** How and when an image was taken. */
export interface Acquisition {
  /** name of the image, unique within a block. */
  image_id: string;
  /** platform or instrument, "" when unknown. */
  sensor: string;
  /** UTC, None when unknown. */
  acquired_at: string | null;
  /** angle between the vertical and the line of sight at the ground, at the centre. */
  incidence_deg: number | null;
  /** from the ground to the sensor, clockwise from north. */
  azimuth_deg: number | null;
  /** at the centre of the image; NaN when unknown. */
  sun_elevation_deg: number | null;
  /** at the centre of the image; NaN when unknown. */
  sun_azimuth_deg: number | null;
}

/** A block whose points were used. */
export interface BlockUsed {
  /** of the block. */
  id: string;
  /** of the block. */
  version: string;
}

/** Accuracy against points that had no part in the registration. */
export interface Check {
  /** what the points are, in words. */
  against: string;
  /** of the registered model there; a single scene gives no heights, hence no LE90. */
  accuracy: Accuracy;
  /** of the marks; x along samples, y along lines; None when not marked. */
  image_residuals_px: ImageResiduals | null;
  /** the residuals in units of what model, marks and points state; None when unknown. */
  normalised: NormalisedError | null;
}

/** The correction that was found, from positions by the delivered model to true ones. */
export interface CorrectionRecord {
  /** "shift", "drift" or "affine". */
  order: string;
  /** the order and why it was chosen, in words. */
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
  /** largest difference between the corrected model and the one written; 0 when that carries the correction exactly. */
  refit_error_px: number | null;
  /** which files carry the correction, and how well, in words. */
  refined_note: string;
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

/** One threshold and whether it was met. */
export interface Criterion {
  /** what is compared, with its unit. */
  name: string;
  /** NaN when it could not be computed; such a criterion is not met. */
  value: number | null;
  /** of the value with the limit. */
  comparison: "at least" | "at most";
  /** as given in the options. */
  limit: number | null;
  /** the verdict that is lost when it is not met. */
  needed_for: "good" | "usable";
  /** whether it was met. */
  passed: boolean;
}

/** How far one place of the image moves between the full solution and those of fewer points. */
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
  /** along samples and lines in the first draw: one redone adjustment, as it is published. */
  x_m: number | null;
  /** along samples and lines in the first draw: one redone adjustment, as it is published. */
  y_m: number | null;
}

/** Residuals of the active points on the ground, metres; a single scene says nothing about heights. */
export interface GroundResiduals {
  /** of the horizontal plane through the point. */
  east: Statistics;
  /** of the horizontal plane through the point. */
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
  /** distance of left-out points from where the others expect them, rms, pixels. */
  left_out_px: number | null;
}

/** How many points a scene was given, and what became of them. */
export interface PointCounts {
  /** points the scene could show (Popini). */
  visible: number;
  /** of these, points that were not tried because others stand for them. */
  unused: number;
  /** found, and their views agree (Spatio). */
  matched: number;
  /** used by the final adjustment (Actif). */
  active: number;
  /** ratios, 0 to 1; NaN over nothing. */
  active_of_matched: number | null;
  /** ratios, 0 to 1; NaN over nothing. */
  active_of_visible: number | null;
}

/** What the covariance of the correction says about positions all over the image. */
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

/** How many points left for one reason. */
export interface ReasonCount {
  /** "not matched", or "deactivated" after a match. */
  stage: string;
  /** as given by the matching or the adjustment. */
  reason: string;
  /** points. */
  count: number;
}

/** The record of one registration, as `report.json` holds it. */
export interface Report {
  /** of the document, with its version. */
  format: "amers-registration-report/1";
  /** of Amers. */
  software_version: string;
  /** UTC. */
  started_at: string | null;
  /** UTC. */
  finished_at: string | null;
  /** "good", "usable" or "failed"; follows from the criteria alone. */
  verdict: "good" | "usable" | "failed";
  /** every threshold with the value held against it. */
  criteria: Criterion[];
  /** what was registered. */
  scene: SceneRecord;
  /** whether on control points or on a reference image. */
  method: "control points" | "reference image";
  /** whose points were used; the reference image, where that was. */
  blocks: BlockUsed[];
  /** what was found. */
  correction: CorrectionRecord;
  /** rounds of matching, in order. */
  passes: SearchStage[];
  /** points visible, matched and active. */
  equipment: PointCounts;
  /** why points are not active, commonest first. */
  reasons: ReasonCount[];
  /** of the active points; x along samples, y along lines. */
  image_residuals_px: ImageResiduals;
  /** of the active points; no heights, which a single scene does not give. */
  ground_residuals_m: GroundResiduals;
  /** the adjustment redone without a part of its points; not absolute accuracy. */
  stability: Stability;
  /** accuracy by the covariance of the correction. */
  predicted: PredictedAccuracy;
  /** of the image by active points. */
  coverage: Coverage;
  /** against points that had no part in the registration. */
  checks: Check[];
  /** of the registration, as it was run. */
  options: Record<string, unknown>;
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
  /** kind of the delivered model. */
  model: string;
  /** accuracy of the model before registration, one standard deviation a coordinate, metres. */
  sigma_m: number | null;
  /** outline on the ground, degrees, not closed. */
  footprint_lon_lat: Numbers[];
}

/** One search of the points through one model. */
export interface SearchStage {
  /** "coarse" or "fine". */
  name: string;
  /** ground sampling of the chips. */
  chip_gsd_m: number | null;
  /** how far they were searched. */
  search_radius_m: number | null;
  /** numbers of points: searched, found, and part of the consensus. */
  tried: number;
  /** numbers of points: searched, found, and part of the consensus. */
  matched: number;
  /** numbers of points: searched, found, and part of the consensus. */
  agreeing: number;
  /** how far the agreeing points lay from where they were expected, root mean square. */
  move_m: number | null;
}

/** The adjustment redone without a part of its points. Shows stability, not absolute accuracy. */
export interface Stability {
  /** of the active points in each draw. */
  kept_share: number | null;
  /** adjustments that succeeded. */
  draws: number;
  /** adjustments that gave no solution. */
  failed_draws: number;
  /** points held out of each draw. */
  held_out_per_draw: number;
  /** of the four corners and the centre; empty when no draw succeeded. */
  displacements: Displacement[];
  /** residuals of the points held out, all draws together; a point counts once in each draw it was held out of. */
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
