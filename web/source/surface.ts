// The surface of a job on the map: its colours with a legend, the height at a click, a profile between two.

import type { Position } from "geojson";
import { BASE, get } from "./api";
import type { StatusInfo, SurfaceHeight, SurfaceHeights } from "./api_types";
import type { Bounds } from "./comparison";
import { facts, figure, fill, h, problem } from "./elements";
import { coordinate } from "./go_to";
import { announce } from "./page";
import { profileChart } from "./profile";
import type { Place } from "./view";

const DECIMALS = 6;
const FOUND = "has a height";

interface Made {
  /** From the finest zoom to the coarsest; none near the poles. */
  tile_limits: { zoom: number }[];
  bounds: Bounds;
  /** Heights of the first and the last colour, metres. */
  height_range_m: [number, number];
  height_colours: string[];
  sigma_m: number | null;
  cells: Record<string, number>;
}

/** The part of a job's page that shows its surface; null for a job that made none, or none that a map shows. */
export function surfaceOnMap(place: Place, { jobID }: StatusInfo, results: Record<string, unknown>): HTMLElement | null {
  const made = results as unknown as Made;
  if (!made.height_colours || !made.tile_limits.length) return null;
  const opacity = h("input", { type: "range", id: "opacity", min: 0, max: 100, value: 100 });
  void draw(place, jobID, made, opacity).catch((error: Error) => console.warn(error.message));
  return h(
    "section",
    { "aria-label": "Surface on the map" },
    h("h2", {}, "Surface on the map"),
    legend(made),
    facts({ "Sigma of the heights, median": figure(made.sigma_m, "m"), "Cells with a height": share(made.cells) }),
    h("label", { for: "opacity" }, "Opacity"),
    opacity,
    new Heights(place, jobID).element,
  );
}

async function draw({ atlas, signal }: Place, job: string, made: Made, opacity: HTMLInputElement): Promise<void> {
  const [west, south, east, north] = made.bounds;
  const fade = await atlas.surface(
    {
      tiles: `${BASE}jobs/${job}/map/surface/tiles/WebMercatorQuad/{z}/{y}/{x}`,
      // Across the antimeridian MapLibre knows no bounds.
      bounds: east > 180 ? [-180, south, 180, north] : made.bounds,
      minzoom: made.tile_limits.at(-1)!.zoom,
      maxzoom: made.tile_limits[0]!.zoom,
    },
    signal,
  );
  opacity.addEventListener("input", () => fade?.(opacity.valueAsNumber / 100));
  atlas.fit({ type: "MultiPoint", coordinates: [[west, south], [east, north]] });
}

function legend({ height_range_m: [low, high], height_colours: colours }: Made): HTMLElement {
  const bar = h("div", { class: "ramp", "aria-hidden": "true" });
  bar.style.background = `linear-gradient(to right, ${colours.join(", ")})`;
  const values = [low, (low + high) / 2, high].map((value) => h("span", {}, `${value.toFixed(1)} m`));
  return h("div", {}, bar, h("p", { class: "ramp-values" }, ...values), h("p", { class: "quiet" }, "Height above the ellipsoid, with a light from the north-west."));
}

function share(cells: Record<string, number>): string {
  const all = Object.values(cells).reduce((sum, count) => sum + count, 0);
  return `${((100 * (cells[FOUND] ?? 0)) / Math.max(all, 1)).toFixed(0)} %`;
}

/** The fields of one or two places, which clicks on the map fill too, and what the surface has there. */
class Heights {
  private readonly outcome = h("div", { role: "status" });
  /** Of the last question: an answer that another question has overtaken is not shown. */
  private asked = 0;
  private readonly from = this.field("from", "Place, or start of a profile");
  private readonly to = this.field("to", "End of the profile");
  readonly element = h(
    "form",
    { onsubmit: (event) => void this.submit(event) },
    h("h2", {}, "Heights"),
    h("p", { class: "quiet" }, "Click the map for the height at a place, and once more for the profile to another one; or write latitude and longitude."),
    this.outcome,
    h("label", { for: "from" }, "Place, or start of a profile"),
    this.from,
    h("label", { for: "to" }, "End of the profile"),
    this.to,
    h("p", {}, h("button", { type: "submit" }, "Show heights")),
  );

  constructor(
    private readonly place: Place,
    private readonly job: string,
  ) {
    place.atlas.pick((position) => void this.clicked(position), place.signal);
    place.signal.addEventListener("abort", () => void place.atlas.show("vectors", []));
  }

  private field(id: string, label: string): HTMLInputElement {
    return h("input", { id, type: "text", autocomplete: "off", placeholder: "43.25, 5.25", title: label });
  }

  private async clicked(position: Position): Promise<void> {
    const isEnd = this.from.value !== "" && this.to.value === "";
    (isEnd ? this.to : this.from).value = words(position);
    if (!isEnd) this.to.value = "";
    await this.show();
    this.outcome.scrollIntoView({ block: "nearest" });
  }

  private async submit(event: Event): Promise<void> {
    event.preventDefault();
    await this.show();
  }

  private async show(): Promise<void> {
    const { atlas, signal } = this.place;
    const own = ++this.asked;
    try {
      const places = [this.from, this.to].map(({ value }) => value.trim()).filter(Boolean).map(read);
      if (!places.length) throw new Error("Write latitude, then longitude, in degrees, as in 43.25, 5.25, or click the map.");
      const { heights } = await get<SurfaceHeights>(`jobs/${this.job}/map/surface/heights?along=${places.flat().join(",")}`, signal);
      if (own !== this.asked) return;
      const status = { status: "active" };
      await atlas.show("vectors", [
        { type: "Feature", properties: status, geometry: { type: "MultiPoint", coordinates: places } },
        ...(places.length > 1 ? [{ type: "Feature", properties: status, geometry: { type: "LineString", coordinates: places } } as const] : []),
      ]);
      fill(this.outcome, places.length > 1 ? profileChart(heights) : h("p", {}, heightWords(heights[0]!)));
      announce(places.length > 1 ? "The profile is shown." : "The height is shown.");
    } catch (error) {
      if (!signal.aborted && own === this.asked) fill(this.outcome, problem(error));
    }
  }
}

function heightWords({ height_m: height, sigma_m: sigma, views, reason }: SurfaceHeight): string {
  if (height == null) return `No height: ${reason}.`;
  const origin = views ? `seen in ${views} images` : "filled from the cells around it";
  return `Height ${height.toFixed(2)} m, sigma ${figure(sigma, "m")}; ${origin}.`;
}

function read(text: string): Position {
  const position = coordinate(text);
  if (!position) throw new Error(`“${text}” is no coordinate. Write latitude, then longitude, in degrees, as in 43.25, 5.25.`);
  return position;
}

function words([longitude, latitude]: Position): string {
  return `${latitude!.toFixed(DECIMALS)}, ${longitude!.toFixed(DECIMALS)}`;
}
