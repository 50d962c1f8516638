// Types of the JSON replies of the service. Made by scripts/make_api_types.py; do not edit.

import type { Geometry, MultiPolygon, Point, Polygon } from "geojson";

/** A figure on the accuracy of a block, with the reference it was measured against. */
export interface AccuracyRecord {
  kind: "relative" | "absolute";
  name: string;
  value: number;
  count: number;
  against: string;
}

/** A file of a STAC item. */
export interface Asset {
  href: string;
  type: string;
  title: string;
  roles: string[];
}

/** A feature of the collection blocks in GeoJSON. */
export interface BlockFeature {
  type: "Feature";
  id: number;
  geometry: Polygon | MultiPolygon | null;
  properties: BlockFeatureProperties;
  links?: Link[];
}

/** Properties of a feature of the collection blocks. */
export interface BlockFeatureProperties {
  number?: number;
  id?: string;
  version?: string;
  title?: string;
  state?: "staged" | "published" | "withdrawn";
  priority?: number;
  n_points?: number;
  n_unserved?: number;
  n_views?: number;
  created_at?: string;
  state_changed_at?: string;
}

/** A page of features of the collection blocks in GeoJSON. */
export interface BlockPage {
  type: "FeatureCollection";
  features: BlockFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

/** The quality of a block, from its points and views. */
export interface BlockQuality {
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

/** One version of a block. */
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

/** A change in the audit trail; `before` or `after` is null where the row did not exist. */
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

/** A page of the audit trail, newest first. */
export interface ChangeRecords {
  changes: ChangeRecord[];
  links: Link[];
}

/** A block after a change. */
export interface ChangedBlock {
  block: BlockRecord;
}

/** A collection of OGC API - Features and of STAC. */
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

/** The collections that the caller may read. */
export interface Collections {
  links: Link[];
  collections: CollectionDescription[];
}

/** The conformance classes of the service. */
export interface Conformance {
  conformsTo: string[];
}

/** A feature of the collection density in GeoJSON. */
export interface DensityFeature {
  type: "Feature";
  id: number;
  geometry: Polygon | MultiPolygon | null;
  properties: DensityFeatureProperties;
  links?: Link[];
}

/** Properties of a feature of the collection density. */
export interface DensityFeatureProperties {
  id?: number;
  n_points?: number;
  n_blocks?: number;
  area_km2?: number;
  points_per_km2?: number;
}

/** A page of features of the collection density in GeoJSON. */
export interface DensityPage {
  type: "FeatureCollection";
  features: DensityFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

/** Five figures of the values of one kind. */
export interface Distribution {
  minimum: number;
  median: number;
  mean: number;
  p90: number;
  maximum: number;
}

/** Where and when the features of a collection are. */
export interface Extent {
  spatial: SpatialExtent;
  temporal: TemporalExtent;
}

/** The state of the service. */
export interface Health {
  status: string;
}

/** An input of a process. */
export interface InputDescription {
  title: string;
  description?: string;
  minOccurs: number;
  schema: Record<string, unknown>;
}

/** Why a job failed, as problem details; `error` names the kind of error. */
export interface JobError {
  type?: string;
  title: string;
  detail?: string;
  error?: string;
  [member: string]: unknown;
}

/** A page of jobs. */
export interface Jobs {
  jobs: StatusInfo[];
  links: Link[];
}

/** A JSON Schema of the properties of a collection. */
export interface JsonSchema {
  "$schema": string;
  "$id": string;
  type: "object";
  title: string;
  properties: Record<string, unknown>;
  additionalProperties: boolean;
}

/** The landing page, which is also a STAC catalog. */
export interface Landing {
  conformsTo: string[];
  type: "Catalog";
  stac_version: string;
  id: string;
  title: string;
  description: string;
  links: Link[];
}

/** A link, RFC 8288. */
export interface Link {
  rel: string;
  href: string;
  type?: string;
  title?: string;
  templated?: boolean;
  method?: string;
  body?: Record<string, unknown>;
}

/** A message of a job; `attempt` is 0 before the first attempt. */
export interface Message {
  at: string;
  attempt: number;
  progress: number;
  message: string;
}

/** The last messages of a job. */
export interface Messages {
  messages: Message[];
  links: Link[];
}

/** A new token; this reply alone has its secret. */
export interface NewTokenRecord {
  id: string;
  name: string;
  scopes: Scope[];
  created_at: string;
  expires_at: string | null;
  revoked_at: string | null;
  subject: string | null;
  upload_quota_bytes: number | null;
  job_quota: number | null;
  secret: string;
}

/** An output of a process. */
export interface OutputDescription {
  title: string;
  description?: string;
  schema: Record<string, unknown>;
}

/** A feature of the collection points in GeoJSON. */
export interface PointFeature {
  type: "Feature";
  id: number;
  geometry: Point | null;
  properties: PointFeatureProperties;
  links?: Link[];
}

/** Properties of a feature of the collection points. */
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
}

/** A feature of the collection point-history in GeoJSON. */
export interface PointHistoryFeature {
  type: "Feature";
  id: number;
  geometry: Point | null;
  properties: PointHistoryFeatureProperties;
  links?: Link[];
}

/** Properties of a feature of the collection point-history. */
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

/** A page of features of the collection point-history in GeoJSON. */
export interface PointHistoryPage {
  type: "FeatureCollection";
  features: PointHistoryFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

/** How one point fared in the scenes that tried to match it. */
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

/** A page of features of the collection points in GeoJSON. */
export interface PointPage {
  type: "FeatureCollection";
  features: PointFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

/** A control point: its accuracy, its views, its history. */
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
  n_views: number;
  saliency: number;
  typology: string | null;
  first_view: string | null;
  last_view: string | null;
  block: string;
  block_version: string;
  views: PointViewProperties[];
}

/** A view of a point: its chip, and the image that the chip was cut from; null where unknown. */
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

/** A control point with its views, a GeoJSON feature. */
export interface PointWithViews {
  type: "Feature";
  id: number;
  geometry: Point;
  properties: PointProperties;
  links: Link[];
}

/** Problem details, RFC 9457. */
export interface Problem {
  type: string;
  title: string;
  status: number;
  detail: string;
  error?: string;
  errors?: Record<string, unknown>[];
  [member: string]: unknown;
}

/** A process with its inputs and outputs, each described by a JSON Schema. */
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

/** A process in a list. */
export interface ProcessSummary {
  id: string;
  title: string;
  description: string;
  version: string;
  jobControlOptions: string[];
  outputTransmission: ("value" | "reference")[];
  links: Link[];
}

/** A page of the processes. */
export interface Processes {
  processes: ProcessSummary[];
  links: Link[];
}

/** A block after its publication, and the version that it superseded; null if there was none. */
export interface PublishedBlock {
  block: BlockRecord;
  superseded: BlockRecord | null;
}

/** A reference image; paths are below AMERS_REFERENCE_FOLDER. */
export interface Reference {
  id: number;
  name: string;
  image: string;
  dem: string | null;
  vertical: string | null;
  geoid: string | null;
  sigma_m: number | null;
  gsd_m: number;
  created_at: string;
  footprint: Geometry;
}

/** Reference images, by name. */
export interface References {
  references: Reference[];
}

/** A file of the results of a job, by reference. */
export interface ResultFile {
  href: string;
  type: string;
  title: string;
}

/** A scene; what its files state about it is null until it is registered. */
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
}

/** A feature of the collection scenes in GeoJSON. */
export interface SceneFeature {
  type: "Feature";
  id: string;
  geometry: Polygon | MultiPolygon | null;
  properties: SceneFeatureProperties;
  links?: Link[];
}

/** Properties of a feature of the collection scenes. */
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

/** A page of features of the collection scenes in GeoJSON. */
export interface ScenePage {
  type: "FeatureCollection";
  features: SceneFeature[];
  links: Link[];
  numberMatched: number;
  numberReturned: number;
  "amers:numberMatchedIsExact"?: boolean;
}

/** Scenes, newest first. */
export interface Scenes {
  scenes: Scene[];
}

/** What a token allows; `register` includes `read`, `admin` includes everything. */
export type Scope = "read" | "register" | "monitor" | "admin";

/** The box of a collection. */
export interface SpatialExtent {
  bbox: number[][];
  crs: string;
}

/** A scene as a STAC item. */
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

/** A page of scenes as STAC items. */
export interface StacItems {
  type: "FeatureCollection";
  features: StacItem[];
  numberMatched: number;
  numberReturned: number;
  links: Link[];
}

/** The state of a job. */
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
}

/** A file in the storage. */
export interface StoredFile {
  name: string;
  size_bytes: number;
  sha256: string;
}

/** The period of a collection; null is an open end. */
export interface TemporalExtent {
  interval: ((string | null)[])[];
}

/** A layer of vector tiles. */
export interface TileLayer {
  id: string;
  dataType: "vector";
  geometryDimension: number;
}

/** The grid of tiles of one zoom. */
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

/** Grids of tiles, one for each zoom. */
export interface TileMatrixSet {
  id: string;
  uri: string;
  crs: string;
  orderedAxes: string[];
  tileMatrices: TileMatrix[];
}

/** A tile matrix set in a list. */
export interface TileMatrixSetItem {
  id: string;
  uri: string;
  links: Link[];
}

/** The tile matrix sets of the service. */
export interface TileMatrixSets {
  tileMatrixSets: TileMatrixSetItem[];
}

/** The vector tiles of a collection. */
export interface TileSet {
  title: string;
  dataType: "vector";
  crs: string;
  tileMatrixSetURI: string;
  links: Link[];
  layers?: TileLayer[];
}

/** The tile sets of a collection. */
export interface TileSets {
  links: Link[];
  tilesets: TileSet[];
}

/** A token without its secret; null quotas are those of the settings. */
export interface TokenRecord {
  id: string;
  name: string;
  scopes: Scope[];
  created_at: string;
  expires_at: string | null;
  revoked_at: string | null;
  subject: string | null;
  upload_quota_bytes: number | null;
  job_quota: number | null;
}

/** Tokens, newest first. */
export interface TokenRecords {
  tokens: TokenRecord[];
}

/** A resumable upload; `offset` is the number of bytes that have arrived. */
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

/** An uploaded archive of a block; `POST /blocks` names it by this id. */
export interface UploadedBlock {
  upload: string;
}
