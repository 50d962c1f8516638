// Drawing on the raw image of a registered scene, and seeing it on the map with its accuracy; and the way back.

import type { Feature, FeatureCollection } from "geojson";
import { blobUrl, get } from "./api";
import type { ResultFile, Scene, StatusInfo } from "./api_types";
import { accuracy, figure, fill, h, plural, problem } from "./elements";
import { announce } from "./page";
import { run, stateText } from "./processes";
import { collection, type Kind, KINDS, type Pixel, type Shape } from "./shapes";
import { tilesOf } from "./tiles";
import { uploadBeside } from "./upload";
import { Viewer } from "./viewer";
import type { Place, ShowView } from "./view";

const DRAWN = "drawn.geojson";
const OF_MAP = "of_map.geojson";
const TERRAINS = /\.(tif|tiff|jp2)$/i;

interface Accurate {
  name: string;
  ce90_m: number | null;
  ce90_earth: number | null;
}
interface Hidden {
  hidden: number | null;
}

type Stated = Parameters<typeof accuracy>[0];

/** Shows the raw image of a scene beside the map; the argument is the job of its registration. */
export const showDrawing: ShowView = async (place, id) => {
  const { panel, atlas, signal } = place;
  const job = await get<StatusInfo>(`jobs/${encodeURIComponent(id)}`, signal);
  const scene = await get<Scene>(`scenes/${String(job.inputs["scene"])}`, signal);
  const state = h("p", { class: "quiet" }, "Opening the image …");
  fill(panel, h("p", {}, h("a", { href: `#/job/${id}` }, "← Registration")), h("h1", { tabindex: -1 }, `Draw on ${scene.name}`), state);
  const tiles = await tilesOf(scene.id, signal, (view) => (state.textContent = `Drawing the tiles: ${stateText(view)}`));
  const section = h("section", { id: "raw-image", "aria-label": "Raw image" });
  document.body.append(section);
  document.body.classList.add("drawing");
  await atlas.show("vectors", []);
  atlas.fit(scene.footprint);
  signal.addEventListener("abort", () => {
    section.remove();
    document.body.classList.remove("drawing");
    void atlas.show("vectors", []);
  });
  new Drawing(place, id, scene, (finished) => new Viewer(section, tiles, finished, signal)).open(state);
};

/** The panel of a drawing: what was drawn, the ground, and what came of it. */
class Drawing {
  private readonly viewer: Viewer;
  private readonly key: string;
  private shapes: Shape[] = [];
  private accurate: Accurate[] = [];
  private readonly list = h("ol", { class: "list", "aria-label": "Drawn" });
  private readonly outcome = h("div", { class: "outcome" });
  private readonly terrain: HTMLSelectElement = h("select", { id: "terrain" });
  private readonly added = h("input", { type: "file", id: "terrain-file", accept: ".tif,.tiff,.jp2" });
  private readonly vertical = h("input", { type: "text", id: "vertical", placeholder: "ellipsoid, EGM96, EPSG:… if the file does not say it" });
  private readonly send = h("button", { type: "submit", class: "strong" }, "Show on the map");
  private readonly ofMap = h("input", { type: "file", id: "of-map", accept: ".geojson,.json" });
  private readonly project = h("button", { type: "submit" }, "Show in the image");
  private readonly projected = h("div", { class: "outcome" });

  constructor(
    private readonly place: Place,
    private readonly registration: string,
    private readonly scene: Scene,
    viewer: (finished: (kind: Kind, vertices: Pixel[]) => void) => Viewer,
  ) {
    this.key = `amers-drawn ${scene.id}`;
    this.shapes = JSON.parse(sessionStorage.getItem(this.key) ?? "[]") as Shape[];
    this.viewer = viewer((kind, vertices) => this.add(kind, vertices));
  }

  /** Fill the panel below its heading, in the place of an element. */
  open(instead: HTMLElement): void {
    this.offerTerrains();
    instead.replaceWith(
      this.tools(),
      h("p", { class: "quiet" }, "Click to set vertices, Enter or a double click ends a shape, drag moves the image. With the keys: arrows, space, Enter, + and −."),
      this.list,
      h(
        "form",
        { onsubmit: (event) => void this.locate(event) },
        h("label", { for: "terrain" }, "Terrain"),
        this.terrain,
        h("label", { for: "terrain-file" }, "Another terrain", h("span", { class: "quiet" }, " GeoTIFF, JPEG 2000")),
        this.added,
        h("label", { for: "vertical" }, "Vertical datum of its heights"),
        this.vertical,
        this.send,
      ),
      this.outcome,
      h("h2", {}, "Vectors of the map"),
      h(
        "form",
        { onsubmit: (event) => void this.bring(event) },
        h("label", { for: "of-map" }, "GeoJSON", h("span", { class: "quiet" }, " longitude and latitude; uses the same terrain")),
        this.ofMap,
        this.project,
      ),
      this.projected,
    );
    this.refresh();
  }

  private tools(): HTMLElement {
    const buttons = (Object.keys(KINDS) as Kind[]).map((kind) => {
      const button: HTMLButtonElement = h("button", { type: "button", "aria-pressed": kind === this.viewer.kind ? "true" : "false", onclick: () => choose() }, KINDS[kind].word);
      const choose = (): void => {
        for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
        this.viewer.choose(kind);
        this.viewer.element.focus();
      };
      return button;
    });
    return h("div", { class: "tools", role: "group", "aria-label": "Draw" }, ...buttons, h("button", { type: "button", onclick: () => this.viewer.finish() }, "End shape"));
  }

  private add(kind: Kind, vertices: Pixel[]): void {
    const count = this.shapes.filter((shape) => shape.kind === kind).length;
    this.shapes = [...this.shapes, { kind, name: `${KINDS[kind].word} ${count + 1}`, vertices }];
    this.accurate = [];
    announce(`${this.shapes.at(-1)!.name} drawn.`);
    this.refresh();
  }

  private refresh(): void {
    sessionStorage.setItem(this.key, JSON.stringify(this.shapes));
    this.viewer.show({ drawn: collection(this.shapes).features });
    this.send.disabled = this.shapes.length === 0;
    fill(this.list, ...this.shapes.map((shape, at) => this.row(shape, at)));
  }

  private row(shape: Shape, at: number): HTMLElement {
    const accurate = this.accurate[at];
    const name = h("input", { type: "text", "aria-label": `Name of ${shape.name}`, value: shape.name, onchange: () => rename() });
    const rename = (): void => {
      shape.name = name.value.trim() || shape.name;
      this.refresh();
    };
    const remove = h("button", { type: "button", "aria-label": `Remove ${shape.name}`, onclick: () => this.remove(at) }, "Remove");
    return h("li", { class: "drawn" }, name, remove, h("span", { class: "quiet" }, accurate ? words(accurate) : vertices(shape)));
  }

  private remove(at: number): void {
    this.shapes = this.shapes.filter((_, other) => other !== at);
    this.accurate = [];
    this.refresh();
    (this.list.querySelector("button") ?? this.viewer.element).focus();
  }

  private offerTerrains(): void {
    const names = this.scene.models.filter((name) => TERRAINS.test(name));
    fill(this.terrain, ...names.map((name) => h("option", { value: name }, name)));
    if (!names.length) fill(this.terrain, h("option", { value: "" }, "none uploaded yet: add one"));
  }

  /** The inputs of both processes, after the upload of a new terrain and of vectors. */
  private async inputs(vectors: File): Promise<Record<string, unknown>> {
    const [terrain] = this.added.files ?? [];
    if (terrain) {
      const name = await uploadBeside(this.scene.id, terrain);
      this.scene.models = [...new Set([...this.scene.models, name])];
      this.offerTerrains();
      this.terrain.value = name;
      this.added.value = "";
    }
    if (!this.terrain.value) throw new Error("A terrain is needed: add one.");
    await uploadBeside(this.scene.id, vectors);
    const vertical = this.vertical.value.trim() || null;
    return { scene: this.scene.id, vectors: vectors.name, dem: this.terrain.value, registration: this.registration, vertical, format: "geojson" };
  }

  /** Bring what was drawn onto the map. */
  private async locate(event: Event): Promise<void> {
    event.preventDefault();
    await this.working(this.send, this.outcome, async (report) => {
      const located = this.shapes;
      const drawn = collection(located);
      const inputs = await this.inputs(file(DRAWN, drawn));
      const job = await run("correct-vectors", { ...inputs, options: { pixels: "corner" } }, this.place.signal, report);
      const results = await this.results(job);
      const onMap = await get<FeatureCollection>(results["vectors.geojson"]!.href, this.place.signal);
      // Accuracies belong to shapes by their order: to none of those drawn or removed meanwhile.
      if (this.shapes === located) this.accurate = onMap.features.map(({ properties }) => properties as Accurate);
      const features = onMap.features.map((feature): Feature => ({ ...feature, properties: { ...feature.properties, status: "active" } }));
      await this.place.atlas.show("vectors", features);
      this.place.atlas.fit({ type: "FeatureCollection", features });
      this.refresh();
      announce(`${plural(features.length, "shape")} on the map.`);
      const inPixels = URL.createObjectURL(file(DRAWN, drawn));
      this.place.signal.addEventListener("abort", () => URL.revokeObjectURL(inPixels));
      fill(
        this.outcome,
        h("h2", {}, "On the map"),
        accuracy(results as unknown as Stated),
        h(
          "ul",
          { class: "list" },
          await this.download(results["vectors.geojson"]!, "on_the_map.geojson", "Shapes on the map"),
          await this.download(results["vertices.geojson"]!, "vertices.geojson", "Every vertex with its accuracy"),
          saved(inPixels, DRAWN, "Shapes in pixels of the image"),
        ),
      );
    });
  }

  /** Bring vectors of the map into the image. */
  private async bring(event: Event): Promise<void> {
    event.preventDefault();
    const [chosen] = this.ofMap.files ?? [];
    if (!chosen) return;
    await this.working(this.project, this.projected, async (report) => {
      const inputs = await this.inputs(new File([chosen], OF_MAP));
      const job = await run("project-vectors", { ...inputs, options: { pixels: "corner" } }, this.place.signal, report);
      const results = await this.results(job);
      const { features } = await get<FeatureCollection>(results["vectors.geojson"]!.href, this.place.signal);
      this.viewer.show({ ofMap: features });
      const hidden = features.filter(({ properties }) => ((properties as Hidden).hidden ?? 0) > 0).length;
      const outside = Number(results["outside"]);
      fill(
        this.projected,
        h("p", {}, `${plural(features.length, "feature")} in the image; ${figure(outside)} outside, ${figure(hidden)} with hidden vertices.`),
        h("ul", { class: "list" }, await this.download(results["vectors.geojson"]!, "in_the_image.geojson", "Vectors in pixels of the image")),
      );
    });
  }

  /** Do a piece of work, with its progress or its error in an element. */
  private async working(button: HTMLButtonElement, state: HTMLElement, work: (report: (job: StatusInfo) => void) => Promise<void>): Promise<void> {
    button.disabled = true;
    const words = h("p", { class: "quiet" }, "Sending …");
    fill(state, words);
    try {
      await work((job) => (words.textContent = stateText(job)));
    } catch (error) {
      if (!this.place.signal.aborted) fill(state, problem(error));
    }
    button.disabled = false;
  }

  private results(job: StatusInfo): Promise<Record<string, ResultFile>> {
    return get<Record<string, ResultFile>>(`jobs/${job.jobID}/results`, this.place.signal);
  }

  private async download({ href }: ResultFile, name: string, words: string): Promise<HTMLElement> {
    return saved(await blobUrl(href, this.place.signal), name, words);
  }
}

function vertices({ vertices: { length } }: Shape): string {
  return length === 1 ? "1 vertex" : `${figure(length)} vertices`;
}

/** The accuracy of a shape: the largest of its vertices. */
function words({ ce90_m: relative, ce90_earth: earth }: Accurate): string {
  const ce90 = (metres: number | null): string => (metres == null ? "unknown" : figure(metres, "m"));
  return `CE90 ${ce90(relative)} to the control points, ${ce90(earth)} on the Earth`;
}

function saved(url: string, name: string, words: string): HTMLElement {
  return h("li", {}, h("a", { href: url, download: name }, words), h("span", { class: "quiet" }, name));
}

function file(name: string, content: FeatureCollection): File {
  return new File([JSON.stringify(content)], name, { type: "application/geo+json" });
}
