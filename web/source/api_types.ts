// Types of the JSON replies of the service. Made by scripts/make_api_types.py; do not edit.

import type { Geometry, MultiPolygon, Point, Polygon } from "geojson";

export interface AccuracyRecord {
  kind: "relative" | "absolute";
  name: string;
  value: number;
  count: number;
  against: string;
}

export interface AdjustedMark {
  name: string;
  line: number;
  sample: number;
  lon: number;
  lat: number;
  height_m: number | null;
  sigma_m: (number | null)[];
  sigma_px: number | null;
  residual_px: (number | null)[];
  residual_m: number | null;
  left_out_px: (number | null)[];
  status: "used" | "rejected" | "in doubt" | "check";
  note: string;
}

export interface AdjustedMarks {
  marks: AdjustedMark[];
  verdict: "good" | "usable" | "failed" | null;
  relative_to_control_points: StatedAccuracy | null;
  on_the_earth: StatedAccuracy | null;
  words: string[];
  next_mark: PlaceOfMarks | null;
  places: PlaceOfMarks[];
  terrain: string | null;
}

export interface Asset {
  href: string;
  type: string;
  title: string;
  roles: string[];
}

export interface BlockFeature {
  type: "Feature";
  id: number;
  geometry: Polygon | MultiPolygon | null;
  properties: BlockFeatureProperties;
  links?: Link[];
}

export interface BlockFeatureProperties {
  number?: number;
  id?: string;
  version?: string;
  title?: string;
  attribution?: string | null;
  state?: "staged" | "published" | "withdrawn";
  priority?: number;
  n_points?: number;
  n_unserved?: number;
  n_views?: number;
  relative_ce90_m?: number | null;
  relative_le90_m?: number | null;
  on_the_earth_ce90_m?: number | null;
  on_the_earth_le90_m?: number | null;
  created_at?: string;
  state_changed_at?: string;
}

export interface BlockPage {
  type: "FeatureCollection";
  features: BlockFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

export interface BlockQuality {
  relative_to_control_points: StatedAccuracy;
  on_the_earth: StatedAccuracy;
  points: number;
  area_km2: number;
  points_per_km2: number;
  share_reaching_half: number;
  share_reaching_quarter: number;
  images_per_point: Distribution;
  views_per_point: Distribution;
  sigma_horizontal_m: Distribution;
  sigma_up_m: Distribution;
  cells: [number, number, number, number][];
  accuracy: AccuracyRecord[];
}

export interface BlockRecord {
  number: number;
  id: string;
  version: string;
  title: string;
  state: "staged" | "published" | "withdrawn";
  priority: number;
  n_points: number;
  n_unserved: number;
  n_views: number;
  checksum: string;
  created_at: string;
  state_changed_at: string;
}

export interface ChangeRecord {
  id: number;
  at: string;
  actor: string | null;
  actor_name: string;
  request_id: string | null;
  job_id: string | null;
  kind: string;
  subject: string;
  action: "created" | "changed" | "deleted";
  before: Record<string, unknown> | null;
  after: Record<string, unknown> | null;
}

export interface ChangeRecords {
  changes: ChangeRecord[];
  links: Link[];
}

export interface ChangedBlock {
  block: BlockRecord;
}

export interface CollectionDescription {
  id: string;
  title: string;
  description: string;
  itemType: "feature";
  crs: string[];
  storageCrs: string;
  type: "Collection";
  stac_version: string;
  license: string;
  extent: Extent;
  links: Link[];
}

export interface Collections {
  links: Link[];
  collections: CollectionDescription[];
}

export interface Conformance {
  conformsTo: string[];
}

export interface DeletedBlock {
  block: BlockRecord;
  n_files: number;
  n_shared_files: number;
}

export interface DensityFeature {
  type: "Feature";
  id: number;
  geometry: Polygon | MultiPolygon | null;
  properties: DensityFeatureProperties;
  links?: Link[];
}

export interface DensityFeatureProperties {
  id?: number;
  n_points?: number;
  n_blocks?: number;
  area_km2?: number;
  points_per_km2?: number;
}

export interface DensityPage {
  type: "FeatureCollection";
  features: DensityFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

export interface Distribution {
  minimum: number;
  median: number;
  mean: number;
  p90: number;
  maximum: number;
}

export interface Extent {
  spatial: SpatialExtent;
  temporal: TemporalExtent;
}

export interface Health {
  status: string;
}

export interface InputDescription {
  title: string;
  description?: string;
  minOccurs: number;
  schema: Record<string, unknown>;
}

export interface InstallationStatus {
  workers: number;
  jobs_waiting: number;
  jobs_running: number;
  oldest_waiting_s: number;
  points_served: number;
  chip_bytes: number;
  database_bytes: number;
  disk_free_bytes: number;
  disk_total_bytes: number;
  damaged_files: number;
}

export interface JobError {
  type?: string;
  title: string;
  detail?: string;
  error?: string;
  [member: string]: unknown;
}

export interface Jobs {
  jobs: StatusInfo[];
  links: Link[];
}

export interface JsonSchema {
  "$schema": string;
  "$id": string;
  type: "object";
  title: string;
  properties: Record<string, unknown>;
  required?: string[];
  additionalProperties: boolean;
}

export interface Landing {
  conformsTo: string[];
  type: "Catalog";
  stac_version: string;
  id: string;
  title: string;
  description: string;
  links: Link[];
}

export interface Link {
  rel: string;
  href: string;
  type?: string;
  title?: string;
  templated?: boolean;
  method?: string;
  body?: Record<string, unknown>;
}

export interface Message {
  at: string;
  attempt: number;
  progress: number;
  message: string;
}

export interface Messages {
  messages: Message[];
  links: Link[];
}

export interface NewTokenRecord {
  id: string;
  name: string;
  scopes: Scope[];
  created_at: string;
  expires_at: string | null;
  revoked_at: string | null;
  subject: string | null;
  storage_quota_bytes: number | null;
  job_quota: number | null;
  secret: string;
}

export interface OutputDescription {
  title: string;
  description?: string;
  schema: Record<string, unknown>;
}

export interface OwnerUsage {
  owner: string | null;
  name: string;
  scenes: number;
  open_uploads: number;
  jobs: number;
  scene_bytes: number;
  upload_bytes: number;
  result_bytes: number;
  total_bytes: number;
  quota_bytes: number | null;
  share: number | null;
}

export interface OwnersUsage {
  owners: OwnerUsage[];
}

export interface PartReadiness {
  status: "ok" | "degraded" | "failed";
  reason?: string;
}

export interface PlaceOfMarks {
  line: number | null;
  sample: number | null;
  lon: number | null;
  lat: number | null;
  height_m: number | null;
  sigma_px: number | null;
  is_height_known: boolean;
}

export interface PointFeature {
  type: "Feature";
  id: number;
  geometry: Point | null;
  properties: PointFeatureProperties;
  links?: Link[];
}

export interface PointFeatureProperties {
  id?: number;
  sigma_east_m?: number;
  sigma_north_m?: number;
  sigma_up_m?: number;
  corr_east_north?: number;
  corr_east_up?: number;
  corr_north_up?: number;
  n_views?: number;
  saliency?: number;
  typology?: string | null;
  first_view?: string | null;
  last_view?: string | null;
  block_number?: number;
  surface_height_m?: number | null;
  surface_sigma_m?: number | null;
}

export interface PointHistoryFeature {
  type: "Feature";
  id: number;
  geometry: Point | null;
  properties: PointHistoryFeatureProperties;
  links?: Link[];
}

export interface PointHistoryFeatureProperties {
  id?: number;
  state?: "served" | "proposed" | "suspended";
  attempts?: number;
  successes?: number;
  expected?: number;
  health?: number;
  last_attempt?: string | null;
  last_success?: string | null;
  mean_residual_px?: number | null;
  mean_east_m?: number | null;
  mean_north_m?: number | null;
  suspended_at?: string | null;
  suspended_because?: string | null;
  block_number?: number;
}

export interface PointHistoryPage {
  type: "FeatureCollection";
  features: PointHistoryFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

export interface PointHistoryRecord {
  state: "served" | "proposed" | "suspended";
  attempts: number;
  successes: number;
  expected: number;
  health: number;
  last_attempt: string | null;
  last_success: string | null;
  mean_residual_px: number | null;
  mean_east_m: number | null;
  mean_north_m: number | null;
  suspended_at: string | null;
  suspended_because: string | null;
  id: number;
}

export interface PointPage {
  type: "FeatureCollection";
  features: PointFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

export interface PointProperties {
  state: "served" | "proposed" | "suspended";
  attempts: number;
  successes: number;
  expected: number;
  health: number;
  last_attempt: string | null;
  last_success: string | null;
  mean_residual_px: number | null;
  mean_east_m: number | null;
  mean_north_m: number | null;
  suspended_at: string | null;
  suspended_because: string | null;
  sigma_east_m: number;
  sigma_north_m: number;
  sigma_up_m: number;
  corr_east_north: number;
  corr_east_up: number;
  corr_north_up: number;
  relative_to_control_points: StatedAccuracy;
  on_the_earth: StatedAccuracy;
  n_views: number;
  saliency: number;
  typology: string | null;
  first_view: string | null;
  last_view: string | null;
  surface_height_m: number | null;
  surface_sigma_m: number | null;
  block: string;
  block_version: string;
  views: PointViewProperties[];
}

export interface PointViewProperties {
  view: number;
  gsd_m: number;
  incidence_deg: number | null;
  azimuth_deg: number | null;
  image_id: string;
  sensor: string;
  acquired_at: string | null;
  sun_elevation_deg: number | null;
  sun_azimuth_deg: number | null;
}

export interface PointWithViews {
  type: "Feature";
  id: number;
  geometry: Point;
  properties: PointProperties;
  links: Link[];
}

export interface Problem {
  type: string;
  title: string;
  status: number;
  detail: string;
  error?: string;
  errors?: Record<string, unknown>[];
  [member: string]: unknown;
}

export interface ProcessDescription {
  id: string;
  title: string;
  description: string;
  version: string;
  jobControlOptions: string[];
  outputTransmission: ("value" | "reference")[];
  links: Link[];
  inputs: Record<string, InputDescription>;
  outputs: Record<string, OutputDescription>;
}

export interface ProcessSummary {
  id: string;
  title: string;
  description: string;
  version: string;
  jobControlOptions: string[];
  outputTransmission: ("value" | "reference")[];
  links: Link[];
}

export interface Processes {
  processes: ProcessSummary[];
  links: Link[];
}

export interface PublishedBlock {
  block: BlockRecord;
  superseded: BlockRecord | null;
}

export interface ReadinessReport {
  status: "ready" | "degraded" | "not ready";
  parts: Record<string, PartReadiness>;
}

export interface Reference {
  id: number;
  name: string;
  image: string;
  dem: string | null;
  vertical: string | null;
  geoid: string | null;
  sigma_m: number | null;
  sigma_up_m: number | null;
  gsd_m: number;
  created_at: string;
  footprint: Geometry;
}

export interface References {
  references: Reference[];
}

export interface ResultFile {
  href: string;
  type: string;
  title: string;
}

export interface Scene {
  id: string;
  name: string;
  state: "uploading" | "uploaded" | "removed";
  file: string;
  models: string[];
  size_bytes: number | null;
  sha256: string | null;
  sigma_m: number | null;
  sensor: string | null;
  acquired: string | null;
  gsd_m: number | null;
  footprint: Geometry | null;
  created: string;
  removed: string | null;
  registrations: SceneRegistration[];
}

export interface SceneFeature {
  type: "Feature";
  id: string;
  geometry: Polygon | MultiPolygon | null;
  properties: SceneFeatureProperties;
  links?: Link[];
}

export interface SceneFeatureProperties {
  id?: string;
  datetime?: string;
  title?: string;
  created?: string;
  platform?: string | null;
  gsd?: number | null;
  "view:incidence_angle"?: number | null;
  "view:azimuth"?: number | null;
  "view:sun_elevation"?: number | null;
  "view:sun_azimuth"?: number | null;
  "amers:state"?: "uploading" | "uploaded" | "removed";
  "amers:acquired"?: string | null;
  "amers:sigma_m"?: number | null;
  "amers:lines"?: number | null;
  "amers:samples"?: number | null;
  "amers:verdict"?: "good" | "usable" | "failed" | null;
}

export interface ScenePage {
  type: "FeatureCollection";
  features: SceneFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

export interface SceneRegistration {
  job: string;
  process: string;
  outcome: "registered" | "failed" | "under way";
  verdict: string | null;
  relative_to_control_points: StatedAccuracy | null;
  on_the_earth: StatedAccuracy | null;
  created: string;
  finished: string | null;
}

export interface Scenes {
  scenes: Scene[];
  links: Link[];
}

export type Scope = "read" | "register" | "monitor" | "admin";

export interface SpatialExtent {
  bbox: number[][];
  crs: string;
}

export interface StacItem {
  type: "Feature";
  stac_version: string;
  stac_extensions: string[];
  id: string;
  geometry: Geometry | null;
  bbox?: number[];
  properties: Record<string, unknown>;
  collection: string;
  assets: Record<string, Asset>;
  links: Link[];
}

export interface StacItems {
  type: "FeatureCollection";
  features: StacItem[];
  numberMatched: number;
  numberReturned: number;
  links: Link[];
}

export interface StatedAccuracy {
  label: string;
  ce90_m: number | null;
  le90_m: number | null;
  words: string;
}

export interface StatusInfo {
  jobID: string;
  processID: string;
  type: "process";
  status: "accepted" | "running" | "successful" | "failed" | "dismissed";
  progress: number;
  message: string | null;
  inputs: Record<string, unknown>;
  created: string;
  started: string | null;
  finished: string | null;
  updated: string;
  error?: JobError;
  links: Link[];
  "amers:queuePosition"?: number;
  "amers:estimatedEnd"?: string;
  "amers:priority"?: number;
  "amers:verdict"?: "good" | "usable" | "failed" | "not registered";
  "amers:sceneNames"?: string[];
  "amers:relative_to_control_points"?: StatedAccuracy;
  "amers:on_the_earth"?: StatedAccuracy;
}

export interface StoredFile {
  name: string;
  size_bytes: number;
  sha256: string;
}

export interface SurfaceHeight {
  distance_m: number;
  lon: number;
  lat: number;
  height_m: number | null;
  sigma_m: number | null;
  views: number;
  reason: string;
}

export interface SurfaceHeights {
  heights: SurfaceHeight[];
}

export interface TemporalExtent {
  interval: ((string | null)[])[];
}

export interface TileLayer {
  id: string;
  dataType: "vector";
  geometryDimension: number;
}

export interface TileMatrix {
  id: string;
  scaleDenominator: number;
  cellSize: number;
  cornerOfOrigin: "topLeft";
  pointOfOrigin: number[];
  tileWidth: number;
  tileHeight: number;
  matrixWidth: number;
  matrixHeight: number;
}

export interface TileMatrixSet {
  id: string;
  uri: string;
  crs: string;
  orderedAxes: string[];
  tileMatrices: TileMatrix[];
}

export interface TileMatrixSetItem {
  id: string;
  uri: string;
  links: Link[];
}

export interface TileMatrixSets {
  tileMatrixSets: TileMatrixSetItem[];
}

export interface TileSet {
  title: string;
  dataType: "vector";
  crs: string;
  tileMatrixSetURI: string;
  links: Link[];
  layers?: TileLayer[];
}

export interface TileSets {
  links: Link[];
  tilesets: TileSet[];
}

export interface TokenRecord {
  id: string;
  name: string;
  scopes: Scope[];
  created_at: string;
  expires_at: string | null;
  revoked_at: string | null;
  subject: string | null;
  storage_quota_bytes: number | null;
  job_quota: number | null;
}

export interface TokenRecords {
  tokens: TokenRecord[];
}

export interface Upload {
  id: string;
  state: "arriving" | "finished";
  purpose: "image" | "model" | "block";
  name: string;
  offset: number;
  size_bytes: number;
  scene: string | null;
  created: string;
  expires: string | null;
}

export interface UploadedBlock {
  upload: string;
}
