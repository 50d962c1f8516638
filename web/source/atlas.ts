// The map: background, land, graticule, density, blocks, points, scenes and the residuals of a registration.

import type { Feature, FeatureCollection, Geometry, Position } from "geojson";
import {
  GeoJSONSource,
  LngLatBounds,
  Map as MapLibre,
  NavigationControl,
  ScaleControl,
  setWorkerUrl,
  VectorTileSource,
} from "maplibre-gl";
import { aimWithKeys } from "./aim";
import { authorization, BASE, get } from "./api";
import { type Bounds, Comparison, type Picture, type Pyramid, type Side, TILE_PX } from "./comparison";
import { h } from "./elements";
import { goToField, TOWNS } from "./go_to";
import { degrees, graticule, wrapped } from "./graticule";
import { metresPerDegree } from "./ground";
import { type Colouring, COLOURINGS, landFile, mapStyle, TOWNS_ZOOM } from "./style";

type Outlined = Feature<Geometry | null>;
type Shape = Geometry | { type: "FeatureCollection"; features: Outlined[] };

const WORLD: Bounds = [-180, -85, 180, 85];
const NEAR_PX = 6;
/** From the edge of a pixel of the screen, as a click has it, to its middle. */
const MIDDLE_PX = 0.5;
/** Distance of the degrees of the graticule from the left, lower and upper edges; at the top is the field to go to a place. */
const LABELS_PX = { left: 6, bottom: 34, top: 62 };
/** Zoom at which a coordinate is shown, if the map is not closer and no view asks for another. */
export const COORDINATE_ZOOM = 11;
/** Closest zoom at which a town is shown. */
const TOWN_ZOOM = 14;
const PLACE_DECIMALS = 6;
/** What the operator has chosen to lie below the map; no tiles: land only. */
interface Background {
  tiles: string | null;
  attribution: string | null;
}

const MAKER_OF_TOWNS = "Towns: GeoNames, CC BY 4.0";

/** Paths below which tiles are for some callers only. */
const PROTECTED = ["collections/", "jobs/", "references/"];

/** The map and its layers; without WebGL the rest of the page works. */
export class Atlas {
  private readonly map: MapLibre | null;
  private readonly ready: Promise<void>;
  private colouring: Colouring = "none";
  private limits: readonly number[] = [];
  private land = landFile(0);
  private namesTowns = false;
  private blocks: Outlined[] = [];
  private picked: ((position: Position, point?: number) => void) | null = null;
  /** Whether the reader has gone to a place: the page then does not move the map by itself. */
  went = false;
  private fitted = false;
  coordinateZoom = COORDINATE_ZOOM;

  constructor(container: HTMLElement, onPoint: (id: number) => void) {
    this.map = opened(container);
    const map = this.map;
    if (!map) {
      this.ready = Promise.resolve();
      return;
    }
    this.ready = new Promise((resolve) => map.once("load", () => resolve()));
    void this.ready.then(() => this.whileMoving(() => this.drawGraticule(map), new AbortController().signal));
    void this.ready.then(() => this.whileMoving(() => this.drawLand(map), new AbortController().signal));
    void this.ready.then(() => this.whileMoving(() => this.drawTowns(map, container), new AbortController().signal));
    void this.ready.then(() => this.whileMoving(() => this.nameMakers(), new AbortController().signal));
    void this.ready.then(() => drawBackground(map, container)).catch((error: Error) => console.warn(error.message));
    for (const event of ["movestart", "dataloading"] as const) map.on(event, () => container.setAttribute("aria-busy", "true"));
    map.on("idle", () => container.setAttribute("aria-busy", "false"));
    map.on("click", ({ point: { x, y } }) => {
      if (!this.picked) {
        const id = pointAt(map, x, y, NEAR_PX);
        if (id !== undefined) onPoint(id);
        return;
      }
      const { lng, lat } = map.unproject([x + MIDDLE_PX, y + MIDDLE_PX]);
      this.picked([wrapped(lng), lat], pointAt(map, x, y, 0));
    });
    const pointer = h("p", { class: "pointer", "aria-hidden": "true" });
    const field = goToField(
      (position) => void this.goTo(position),
      (coordinates) => {
        this.went = true;
        this.fit({ type: "MultiPoint", coordinates }, TOWN_ZOOM);
      },
    );
    container.append(pointer, field);
    map.on("mousemove", ({ lngLat }) => (pointer.textContent = place(wrapped(lngLat.lng), lngLat.lat)));
    map.on("mouseout", () => (pointer.textContent = ""));
    for (const layer of ["points", "vector-points"]) {
      map.on("mouseenter", layer, () => (map.getCanvas().style.cursor = "pointer"));
      map.on("mouseleave", layer, () => (map.getCanvas().style.cursor = ""));
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (scheme) => this.repaint(scheme.matches));
  }

  bounds(): Bounds {
    if (!this.map) return WORLD;
    const seen = this.map.getBounds();
    const whole = seen.getEast() - seen.getWest() >= 360;
    const [west, east] = whole ? [-180, 180] : [wrapped(seen.getWest()), wrapped(seen.getEast())];
    return [west, Math.max(seen.getSouth(), -90), east, Math.min(seen.getNorth(), 90)];
  }

  /** Call back now and after every move of the map, until the signal aborts. */
  whileMoving(callback: () => void, signal: AbortSignal): void {
    callback();
    this.map?.on("moveend", callback);
    signal.addEventListener("abort", () => this.map?.off("moveend", callback));
  }

  /** Leave out the points of the blocks, until the signal aborts: a view draws points of its own. */
  async hidePoints(signal: AbortSignal): Promise<void> {
    await this.ready;
    if (signal.aborted) return;
    this.map?.setLayoutProperty("points", "visibility", "none");
    signal.addEventListener("abort", () => this.map?.setLayoutProperty("points", "visibility", "visible"));
  }

  /** Metres on the ground of a pixel of the screen in the middle of the map. */
  metresOfPixel(): number {
    if (!this.map) return 1;
    const { lng, lat } = this.map.getCenter();
    const { x, y } = this.map.project([lng, lat]);
    return (lat - this.map.unproject([x, y + 1]).lat) * metresPerDegree(lat).north;
  }

  /** Lay an element over the map, until the signal aborts. */
  overlay(element: HTMLElement, signal: AbortSignal): void {
    if (!this.map) return;
    this.map.getContainer().append(element);
    signal.addEventListener("abort", () => element.remove());
  }

  /**
   * Bring a shape into view, at the zoom `closest` at most: by default where a small scene fills the map.
   * The first one is there at once, later ones are flown to.
   */
  fit(geometry: Shape | null | undefined, closest = 18): void {
    const positions = geometry ? inOnePlace(positionsOf(geometry)) : [];
    if (!this.map || positions.length === 0) return;
    const box = positions.reduce((box, position) => box.extend([position[0]!, position[1]!]), new LngLatBounds());
    const padding = Math.min(60, this.map.getContainer().clientHeight / 6);
    const animate = this.fitted && !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.fitted = true;
    this.map.fitBounds(box, { padding, maxZoom: closest, animate });
  }

  /** The property that colours the points; it stays for all views of the page. */
  get pointColouring(): Colouring {
    return this.colouring;
  }

  /** The values at which classes of the points meet. */
  get pointLimits(): readonly number[] {
    return this.limits;
  }

  colourPoints(colouring: Colouring, limits: readonly number[] = COLOURINGS[colouring].limits): void {
    this.colouring = colouring;
    this.limits = limits;
    void this.ready.then(() => this.repaint(matchMedia("(prefers-color-scheme: dark)").matches));
  }

  async choose(id: number | null): Promise<void> {
    await this.ready;
    this.map?.setFilter("chosen", ["==", ["get", "id"], id ?? -1]);
  }

  /** Replace the features of a layer that the page fills itself. */
  async show(source: "blocks" | "scenes" | "vectors" | "marks" | "graticule" | "target", features: Outlined[]): Promise<void> {
    await this.ready;
    const layer = this.map?.getSource(source);
    if (layer instanceof GeoJSONSource) layer.setData({ type: "FeatureCollection", features } as FeatureCollection);
    if (source !== "blocks") return;
    this.blocks = features;
    this.nameMakers();
  }

  /** Name on the map who made the data of the blocks in view. */
  private nameMakers(): void {
    if (this.map) attribute(this.map.getContainer(), "blocks", makersOf(this.blocks, this.map.getBounds()));
  }

  /** Show two pictures below the outlines of scenes, until the signal aborts; null without a map. */
  async compare(pictures: Record<Side, Picture>, signal: AbortSignal): Promise<Comparison | null> {
    await this.ready;
    if (!this.map || signal.aborted) return null;
    const comparison = new Comparison(this.map, pictures, "scenes-inside");
    signal.addEventListener("abort", () => comparison.remove());
    return comparison;
  }

  /** Show a surface, or an image, below the outlines of scenes, until the signal aborts; returns what sets its opacity, 0 to 1. */
  async surface({ tiles, ...pyramid }: Pyramid, signal: AbortSignal): Promise<((opacity: number) => void) | null> {
    await this.ready;
    const map = this.map;
    if (!map || signal.aborted) return null;
    map.addSource("surface", { type: "raster", tileSize: TILE_PX, ...pyramid, tiles: [tiles] });
    map.addLayer({ id: "surface", type: "raster", source: "surface", paint: { "raster-fade-duration": 0 } }, "scenes-inside");
    signal.addEventListener("abort", () => {
      map.removeLayer("surface");
      map.removeSource("surface");
    });
    return (opacity) => map.setPaintProperty("surface", "raster-opacity", opacity);
  }

  /** Call back with the position of every click, and the control point there, instead of opening points, until the signal aborts. */
  pick(callback: (position: Position, point?: number) => void, signal: AbortSignal): void {
    this.picked = callback;
    signal.addEventListener("abort", () => (this.picked = null));
  }

  /** Let the keys pick, too: arrows move the map below a crosshair in its middle, Enter picks what is there. */
  aim(label: string, signal: AbortSignal): void {
    if (!this.map) return;
    const map = this.map;
    aimWithKeys(map, label, signal, () => {
      const { lng, lat } = map.getCenter();
      const { x, y } = map.project([lng, lat]);
      this.picked?.([wrapped(lng), lat], pointAt(map, x, y, 0));
    });
  }

  /** Load points and densities again, after a block was published or withdrawn. */
  refresh(): void {
    for (const name of ["points", "density"]) {
      const source = this.map?.getSource(name);
      if (source instanceof VectorTileSource) source.setTiles(source.tiles);
    }
  }

  /** Mark a position, and show its surroundings, if the map is not closer. */
  async goTo(position: Position): Promise<void> {
    this.went = true;
    await this.show("target", [{ type: "Feature", properties: {}, geometry: { type: "Point", coordinates: position } }]);
    const [longitude, latitude] = position as [number, number];
    this.map?.jumpTo({ center: [longitude, latitude], zoom: Math.max(this.map.getZoom(), this.coordinateZoom) });
  }

  /** Load the land of the present scale, when the scale asks for another. */
  private drawLand(map: MapLibre): void {
    const file = landFile(map.getZoom());
    const source = map.getSource("land");
    if (file === this.land || !(source instanceof GeoJSONSource)) return;
    this.land = file;
    source.setData(BASE + file);
  }

  /** Load the towns when the map first comes so close that it names them. */
  private drawTowns(map: MapLibre, container: HTMLElement): void {
    const source = map.getSource("towns");
    if (this.namesTowns || map.getZoom() < TOWNS_ZOOM || !(source instanceof GeoJSONSource)) return;
    this.namesTowns = true;
    source.setData(BASE + TOWNS);
    attribute(container, "towns", MAKER_OF_TOWNS);
  }

  private drawGraticule(map: MapLibre): void {
    const seen = map.getBounds();
    const corner = map.unproject([LABELS_PX.left, map.getContainer().clientHeight - LABELS_PX.bottom]);
    const top = map.unproject([LABELS_PX.left, LABELS_PX.top]).lat;
    const labels = { longitude: corner.lng, latitude: corner.lat, top };
    const [west, south, east, north] = [seen.getWest(), seen.getSouth(), seen.getEast(), seen.getNorth()];
    void this.show("graticule", graticule({ west, south, east, north, labels }));
  }

  private repaint(dark: boolean): void {
    for (const layer of mapStyle(dark, this.colouring, this.limits).layers) {
      const paint = Object.entries(layer.paint ?? {}) as [Parameters<MapLibre["setPaintProperty"]>[1], unknown][];
      for (const [name, value] of paint) this.map?.setPaintProperty(layer.id, name, value as never);
    }
  }
}

/** The control point whose circle is nearer to a place of the screen than some pixels. */
function pointAt(map: MapLibre, x: number, y: number, near: number): number | undefined {
  const box: [[number, number], [number, number]] = [
    [x - near, y - near],
    [x + near, y + near],
  ];
  const [point] = map.queryRenderedFeatures(box, { layers: ["points", "vector-points"] });
  const id = point?.properties["id"] ?? point?.id;
  return id === undefined ? undefined : Number(id);
}

/** Draw the background that the operator has chosen above the land, and name who made it. */
async function drawBackground(map: MapLibre, container: HTMLElement): Promise<void> {
  const { tiles, attribution } = await get<Background>("map/background.json");
  if (!tiles) return;
  const address = tiles.startsWith("/") ? location.origin + tiles : tiles;
  map.addSource("background", { type: "raster", tiles: [address], tileSize: 256 });
  map.addLayer({ id: "background", type: "raster", source: "background" }, "density");
  attribute(container, "background", attribution ?? "");
}

/** Name on the map who made a part of it; nobody where the name is empty. */
function attribute(container: HTMLElement, part: string, maker: string): void {
  const line = container.querySelector<HTMLElement>(".attribution") ?? h("p", { class: "attribution" });
  const makers = new Map(Object.entries(line.dataset)).set(part, maker);
  line.dataset[part] = maker;
  line.textContent = [...makers.values()].filter(Boolean).join(" · ");
  if (!line.textContent) line.remove();
  else if (!line.isConnected) container.prepend(line);
}

/** What the terms of the data of published blocks in view ask to show. */
function makersOf(blocks: Outlined[], seen: LngLatBounds): string {
  const shown = blocks.filter(({ geometry, properties }) => properties?.["state"] === "published" && geometry && meets(positionsOf(geometry), seen));
  return [...new Set(shown.map(({ properties }) => properties?.["attribution"] as string | null))].filter(Boolean).join(" · ");
}

/** Whether the box around positions meets what is seen, which may lie beyond 180 degrees. */
function meets(positions: Position[], seen: LngLatBounds): boolean {
  const box = inOnePlace(positions).reduce((box, [lon, lat]) => box.extend([lon!, lat!]), new LngLatBounds());
  const beside = [-360, 0, 360].some((turn) => box.getWest() + turn <= seen.getEast() && box.getEast() + turn >= seen.getWest());
  return beside && box.getSouth() <= seen.getNorth() && box.getNorth() >= seen.getSouth();
}

function opened(container: HTMLElement): MapLibre | null {
  setWorkerUrl(`${BASE}map/worker.js`);
  try {
    const map = new MapLibre({
      container,
      style: mapStyle(matchMedia("(prefers-color-scheme: dark)").matches, "none"),
      fadeDuration: 0,
      center: [10, 25],
      zoom: 1.2,
      attributionControl: false,
      dragRotate: false,
      pitchWithRotate: false,
      touchPitch: false,
      transformRequest: (url) => ({ url, headers: PROTECTED.some((path) => url.startsWith(BASE + path)) ? authorization() : {} }),
    });
    map.touchZoomRotate.disableRotation();
    map.keyboard.disableRotation();
    map.addControl(new NavigationControl({ showCompass: false }), "top-right");
    map.addControl(new ScaleControl({ maxWidth: 120 }), "bottom-right");
    map.on("error", (event) => console.warn(event.error.message));
    return map;
  } catch (error) {
    container.append(`The map cannot be shown: ${error instanceof Error ? error.message : "no WebGL"}`);
    return null;
  }
}

/** A place in degrees, to about 0.1 m. */
function place(longitude: number, latitude: number): string {
  return `${degrees(latitude, "N", "S", PLACE_DECIMALS)}  ${degrees(longitude, "E", "W", PLACE_DECIMALS)}`;
}

/** Positions with longitudes beyond 180 degrees where that keeps an outline together that was cut there. */
function inOnePlace(positions: Position[]): Position[] {
  const onwards = positions.map(([lon, lat]): Position => [lon! < 0 ? lon! + 360 : lon!, lat!]);
  return width(positions) > 180 && width(onwards) < width(positions) ? onwards : positions;
}

function width(positions: Position[]): number {
  const [west, east] = positions.reduce(([west, east], [lon]) => [Math.min(west!, lon!), Math.max(east!, lon!)], [360, -180]);
  return east! - west!;
}

function positionsOf(geometry: Shape): Position[] {
  switch (geometry.type) {
    case "FeatureCollection":
      return geometry.features.flatMap((feature) => (feature.geometry ? positionsOf(feature.geometry) : []));
    case "GeometryCollection":
      return geometry.geometries.flatMap(positionsOf);
    case "Point":
      return [geometry.coordinates];
    case "MultiPoint":
    case "LineString":
      return geometry.coordinates;
    case "MultiLineString":
    case "Polygon":
      return geometry.coordinates.flat();
    case "MultiPolygon":
      return geometry.coordinates.flat(2);
  }
}
