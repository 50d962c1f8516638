// What may stand on either side of the divider: this scene, references, chips of the points, other registered scenes.

import type { FeatureCollection, Geometry, Point, Polygon, Position } from "geojson";
import { BASE, get } from "./api";
import type { PointWithViews, Reference, References, Scene, StatusInfo } from "./api_types";
import type { Bounds, Patch, Picture, Pyramid } from "./comparison";
import { figure } from "./elements";
import { everyRow } from "./following";
import { metresPerDegree } from "./ground";
import { drawn, drawnEarlier, stateText } from "./processes";
import type { PointResultProperties } from "./residuals";

const PROCESS = "map-scene";
/** Metres of a pixel of a tile of 256 px at zoom 0 on the equator, and zooms that the service draws below the finest. */
const ZOOM_0_M = 40_075_017 / 256;
const COARSER_ZOOMS = 3;
/** Half the side of a chip in its pixels, and the number of points whose chips are shown, each with requests of its own. */
const HALF_CHIP = 50.5;
const MOST_CHIPS = 60;

interface Limits {
  zoom: number;
}
/** The results of the drawing of a scene; drawings of earlier versions have no outlines. */
export interface Mapped {
  /** From the finest zoom to the coarsest. */
  tile_limits: Limits[];
  bounds: Bounds;
  heights: string;
  outlines?: Record<"raw" | "registered", Position[]>;
}

/** A picture that is made when it is chosen. */
export interface Choice {
  name: string;
  make: () => Promise<Picture>;
}

/** Draw a registered scene through both of its models, or find an earlier drawing; `report` gets the state of the job. */
export async function drawScene(
  inputs: { scene: unknown; registration: string; model: unknown },
  signal: AbortSignal,
  report: (state: string) => void,
): Promise<{ mapped: Mapped; raw: Picture; registered: Picture }> {
  const { job, results } = await drawn(PROCESS, inputs, signal, (job) => report(stateText(job)));
  const mapped = results as unknown as Mapped;
  const picture = (model: "raw" | "registered", name: string): Picture => ({ name, pyramid: pyramid(job, model, mapped), outline: mapped.outlines?.[model] ?? [] });
  return { mapped, raw: picture("raw", "Raw"), registered: picture("registered", "Registered") };
}

/** The edge of the pixels of a registered scene; null where its image was never drawn: no other outline fits the pixels. */
export async function outlineOf(registration: StatusInfo, signal: AbortSignal): Promise<Polygon | null> {
  const { scene, model } = registration.inputs;
  if (registration.processID !== "register-scene") return null;
  const earlier = await drawnEarlier(PROCESS, { scene, registration: registration.jobID, model: model ?? null }, signal);
  const ring = (earlier?.results as Mapped | undefined)?.outlines?.registered;
  return ring?.length ? { type: "Polygon", coordinates: [[...ring, ring[0]!]] } : null;
}

/** References that show some ground, the finest first, chips of the points of a registration, and other scenes. */
export async function otherPictures(
  registration: StatusInfo,
  points: FeatureCollection<Point, PointResultProperties>,
  bounds: Bounds,
  signal: AbortSignal,
  report: (state: string) => void,
): Promise<Choice[]> {
  const [references, scenes] = await Promise.all([referencesOf(bounds, signal), registeredScenes(bounds, registration, signal)]);
  const used = points.features.filter(({ id, properties }) => id != null && properties.status === "active");
  return [
    ...references.map((one): Choice => ({ name: `Reference ${one.name}`, make: async () => ({ name: one.name, pyramid: pyramidOf(one) }) })),
    ...(used.length ? [{ name: "Chips of the points", make: async () => ({ name: "Chips", patches: await chips(used, signal) }) }] : []),
    ...scenes.map(({ id, name, job }): Choice => {
      const make = async (): Promise<Picture> => ({ ...(await drawScene({ scene: id, registration: job, model: null }, signal, report)).registered, name });
      return { name: `Scene ${name}, registered`, make };
    }),
  ];
}

/** The references that show some ground, the finest first. */
export async function referencesOf(bounds: Bounds, signal: AbortSignal): Promise<Reference[]> {
  const { references } = await get<References>("references", signal);
  return references.filter((one) => meet(boundsOf(positionsIn(one.footprint)), bounds)).sort((one, other) => one.gsd_m - other.gsd_m);
}

/** The tiles of a reference image. */
export function pyramidOf(reference: Reference): Pyramid {
  const bounds = boundsOf(positionsIn(reference.footprint));
  const metres = ZOOM_0_M * Math.cos((bounds[1] * Math.PI) / 180);
  const maxzoom = Math.max(Math.ceil(Math.log2(metres / reference.gsd_m)), COARSER_ZOOMS);
  const tiles = `${BASE}references/${encodeURIComponent(reference.name)}/tiles/WebMercatorQuad/{z}/{y}/{x}`;
  return { tiles, bounds: tileBounds(bounds), minzoom: maxzoom - COARSER_ZOOMS, maxzoom };
}

/** A reference in a list of choices. */
export function referenceWords({ name, gsd_m: gsd }: Reference): string {
  return `${name}, ${figure(gsd, "m")} pixels`;
}

export function boundsOf(positions: Position[]): Bounds {
  const [lons, lats] = [positions.map(([lon]) => lon!), positions.map(([, lat]) => lat!)];
  return [Math.min(...lons), Math.min(...lats), Math.max(...lons), Math.max(...lats)];
}

async function registeredScenes(bounds: Bounds, registration: StatusInfo, signal: AbortSignal): Promise<{ id: string; name: string; job: string }[]> {
  const scenes = await everyRow<"scenes", Scene>("scenes?limit=1000", "scenes", signal);
  const there = scenes.filter(({ id, footprint, removed }) => !removed && id !== registration.inputs["scene"] && meet(boundsOf(positionsIn(footprint)), bounds));
  return there.flatMap(({ id, name, registrations: [last] }) =>
    last?.outcome === "registered" && last.process === "register-scene" ? [{ id, name, job: last.job }] : [],
  );
}

/** The first chip of each of some points, spread over all, at its place: north up, around the point. */
async function chips(points: FeatureCollection<Point>["features"], signal: AbortSignal): Promise<Patch[]> {
  const step = Math.max(1, points.length / MOST_CHIPS);
  const chosen = points.filter((_, at) => Math.floor(at / step) !== Math.floor((at - 1) / step));
  const patches = await Promise.all(chosen.map(({ id }) => chip(id!, signal).catch(() => null)));
  signal.throwIfAborted();
  const found = patches.filter((patch) => patch !== null);
  if (!found.length) throw new Error("The points of this registration are no longer served: their chips cannot be shown.");
  return found;
}

async function chip(id: string | number, signal: AbortSignal): Promise<Patch | null> {
  const { geometry, properties } = await get<PointWithViews>(`collections/points/items/${id}`, signal);
  const [view] = properties.views;
  if (!view?.gsd_m) return null;
  const [lon, lat] = geometry.coordinates as [number, number];
  const metres = metresPerDegree(lat);
  const [east, north] = [(HALF_CHIP * view.gsd_m) / metres.east, (HALF_CHIP * view.gsd_m) / metres.north];
  const corners: Patch["corners"] = [[lon - east, lat + north], [lon + east, lat + north], [lon + east, lat - north], [lon - east, lat - north]];
  return { url: `${BASE}collections/points/items/${id}/chips/0?f=png`, corners };
}

function pyramid({ jobID }: StatusInfo, model: "raw" | "registered", { tile_limits: limits, bounds }: Mapped): Pyramid {
  const tiles = `${BASE}jobs/${jobID}/map/${model}/tiles/WebMercatorQuad/{z}/{y}/{x}`;
  return { tiles, bounds: tileBounds(bounds), minzoom: limits.at(-1)!.zoom, maxzoom: limits[0]!.zoom };
}

/** Across the antimeridian MapLibre knows no bounds. */
function tileBounds([west, south, east, north]: Bounds): Bounds {
  return east > 180 || east - west > 180 ? [-180, south, 180, north] : [west, south, east, north];
}

/** The positions of an outline. */
export function positionsIn(footprint: Geometry | null): Position[] {
  if (footprint?.type === "Polygon") return footprint.coordinates.flat();
  return footprint?.type === "MultiPolygon" ? footprint.coordinates.flat(2) : [];
}

function meet([west, south, east, north]: Bounds, other: Bounds): boolean {
  return west < other[2] && east > other[0] && south < other[3] && north > other[1];
}
