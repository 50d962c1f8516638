// Marking ground points in a raw image: the image and the map side by side, residuals after each mark, the file, the registration.

import type { Feature, Position } from "geojson";
import { register } from "./again";
import { COORDINATE_ZOOM } from "./atlas";
import { call, get } from "./api";
import type { AdjustedMark, AdjustedMarks, PlaceOfMarks, ResultFile, Scene, StatusInfo } from "./api_types";
import { fill, h, plural, problem } from "./elements";
import { type Begun, History, type InImage, type Mark, nothingBegun, type OnGround, parseInImage, parseOnGround, readCsv, type State, type Stated, unlike, writeCsv } from "./marks";
import { notesOn, StatedFields, verdictOn } from "./marks_accuracy";
import { PointChip, pointOnGround } from "./marks_point";
import { referenceChoice } from "./marks_reference";
import { MarksTable } from "./marks_table";
import { beyond, groundText, imageText, inOrder, shown } from "./marks_typed";
import { announce, go } from "./page";
import { run, stateText } from "./processes";
import type { Pixel } from "./shapes";
import { tilesOf } from "./tiles";
import { uploadBeside } from "./upload";
import type { Place, ShowView } from "./view";
import { type Expected, type Marked, Viewer } from "./viewer";

const FILE = "marks.csv";
const OF_IMAGE = "Raw image. Arrow keys move the crosshair, with Shift by a pixel, Enter sets the mark there, plus and minus magnify.";
const OF_MAP = "Map. Arrow keys move it below the crosshair in its middle, with Shift by a pixel, Enter sets the mark there, plus and minus zoom.";
/** Metres of a pixel of the map at zoom 0 on the equator: the circumference of the Earth over a tile of 512 px. */
const ZOOM_0_M = 40_075_017 / 512;
const LARGEST_ZOOM = 20;
/** From the corner of a pixel, where the viewer counts from, to its centre. */
const CENTRE = 0.5;
/** Radius within which nine of ten places lie, in standard deviations of each coordinate. */
const CE90_SIGMAS = 2.146;
/** The part of the image around a place that is gone to, pixels. */
const AROUND_PX = 60;

/** A model that a job has read: its job, and whether places need heights. */
interface ReadModel {
  job: string;
  lines: number;
  samples: number;
  needsHeights: boolean;
}

/** Shows the raw image of a scene beside the map, to mark points in both; the argument is the scene. */
export const showMarking: ShowView = async (place, id) => {
  const { panel, atlas, signal } = place;
  const scene = await get<Scene>(`scenes/${encodeURIComponent(id)}`, signal);
  const state = h("p", { class: "quiet", role: "status" }, "Opening the image …");
  fill(panel, h("p", {}, h("a", { href: `#/scene/${scene.id}` }, "← Scene")), h("h1", { tabindex: -1 }, `Mark points in ${scene.name}`), state);
  const report = (job: StatusInfo): string => (state.textContent = stateText(job));
  // One after the other: a worker that reads the model first refuses a scene without one at once.
  const model = await readModel(scene, signal, report);
  const tiles = await tilesOf(scene.id, signal, report);
  const section = h("section", { id: "raw-image", "aria-label": "Raw image" });
  const map = document.getElementById("map")!;
  panel.before(section, map);
  document.body.classList.add("marking");
  signal.addEventListener("abort", () => {
    section.remove();
    panel.after(map);
    document.body.classList.remove("marking");
    atlas.coordinateZoom = COORDINATE_ZOOM;
    for (const layer of ["marks", "target", "scenes"] as const) void atlas.show(layer, []);
  });
  const marking = new Marking(place, scene, model, (finished) => new Viewer(section, tiles, finished, signal, OF_IMAGE));
  await marking.open(state);
};

/** The delivered model of a scene, read anew: its files may have been replaced. */
async function readModel({ id }: Scene, signal: AbortSignal, report: (job: StatusInfo) => void): Promise<ReadModel> {
  const { jobID: job } = await run("read-model", { scene: id }, signal, report);
  const results = await get<{ "scene_model.json": ResultFile; lines: number; samples: number }>(`jobs/${job}/results`, signal);
  const document = await get<object>(results["scene_model.json"].href, signal);
  return { job, lines: results.lines, samples: results.samples, needsHeights: "rpc" in document };
}

/** The panel of marks, and what the image and the map show of them. */
class Marking {
  private readonly viewer: Viewer;
  private readonly history: History;
  private readonly key: string;
  private results = new Map<string, AdjustedMark>();
  private terrain: string | null = null;
  private next: PlaceOfMarks | null = null;
  private request = new AbortController();
  private outline: Position[] = [];
  /** Whether it is known where heights come from: until then nothing is chosen. */
  private isOpen = false;

  private readonly heading = h("h2");
  private readonly prompt = h("p", { class: "prompt", role: "status" });
  private readonly image = h("input", { id: "in-image", autocomplete: "off", spellcheck: false, placeholder: "1204.5, 3310" });
  private readonly ground = h("input", { id: "on-ground", autocomplete: "off", spellcheck: false, placeholder: "5.25331, 43.25242, 120" });
  private readonly chip: PointChip;
  private readonly mistake = h("div");
  private readonly undo = h("button", { type: "button", onclick: () => this.back() }, "Undo");
  private readonly redo = h("button", { type: "button", onclick: () => this.forth() }, "Redo");
  private readonly save = h("button", { type: "button", onclick: () => this.download() }, "Save as CSV");
  private readonly file = h("input", { type: "file", id: "open-marks", accept: ".csv", onchange: () => void this.openFile() });
  private readonly send = h("button", { type: "button", class: "strong", onclick: () => void this.register() }, "Register with these marks");
  /** Whether the last place on the ground was typed: the next one is, too, so its field gets the focus. */
  private isTyped = false;
  private readonly onward = h("button", { type: "button", onclick: () => this.goOn() }, "Go to where the next mark helps most");
  private readonly summary = h("div", { class: "summary", role: "status" });
  private readonly notes = h("div");
  private readonly stated = new StatedFields(() => void this.adjust());
  private readonly table = new MarksTable({
    rename: (mark, name) => this.replace(mark, { ...mark, name: unlike(name, this.marks.filter((one) => one !== mark)) }),
    check: (mark, check) => this.replace(mark, { ...mark, check }),
    show: (mark) => this.look(mark),
    change: (mark) => this.change(mark),
    remove: (mark) => this.put({ marks: this.marks.filter((one) => one !== mark), begun: this.begun }, `${mark.name} removed.`),
  });

  constructor(
    private readonly place: Place,
    private readonly scene: Scene,
    private readonly model: ReadModel,
    viewer: (finished: (kind: string, vertices: Pixel[]) => void) => Viewer,
  ) {
    this.key = `amers-marks ${scene.id}`;
    this.chip = new PointChip(place.signal);
    const kept = JSON.parse(sessionStorage.getItem(this.key) ?? "null") as { state: State; stated: Stated } | null;
    this.history = new History(kept?.state ?? { marks: [], begun: nothingBegun([]) });
    this.stated.value = kept?.stated ?? {};
    this.viewer = viewer((_, [at]) => this.choose({ image: { sample: at![0] - CENTRE, line: at![1] - CENTRE } }));
  }

  private get marks(): Mark[] {
    return this.history.now.marks;
  }

  private get begun(): Begun {
    return this.history.now.begun;
  }

  /** Fill the panel below its heading, in the place of an element, and begin. */
  async open(instead: HTMLElement): Promise<void> {
    const { panel, atlas, signal } = this.place;
    const { lines, samples } = this.model;
    const corners = [[0, 0], [0, samples - 1], [lines - 1, samples - 1], [lines - 1, 0]].map(([line, sample]) => ({ line, sample }));
    const { places } = await this.ask([], corners);
    this.outline = places.filter(({ lon }) => lon != null).map(({ lon, lat }) => [lon!, lat!]);
    const [[lon, lat] = [NaN, NaN], [otherLon, otherLat] = [NaN, NaN]] = this.outline as [number, number][];
    const side_deg = Math.hypot((otherLon! - lon!) * Math.cos(radians(lat!)), otherLat! - lat!);
    if (side_deg > 0) atlas.coordinateZoom = zoomOf(side_deg / samples, lat!);
    const geometry = { type: "Polygon" as const, coordinates: [[...this.outline, ...this.outline.slice(0, 1)]] };
    await atlas.show("scenes", [{ type: "Feature", geometry, properties: { id: this.scene.id, name: this.scene.name } }]);
    atlas.fit(geometry);
    const reference = await referenceChoice(atlas, this.outline, signal);
    const tools = h("div", { class: "tools", role: "group", "aria-label": "Marks" }, this.undo, this.redo, this.save, this.send);
    instead.replaceWith(h("div", { class: "marking-panel" }, h("div", {}, this.form(), this.chip.element, this.mistake), h("div", {}, h("div", { class: "marking-head" }, tools, this.summary), this.table.element, this.onward, this.notes, this.stated.element, this.fileField())));
    panel.ownerDocument.addEventListener("keydown", (event) => this.shortcut(event), { signal });
    atlas.pick((position, point) => void this.chooseOnMap(position, point), signal);
    atlas.aim(OF_MAP, signal);
    if (reference) this.chip.element.after(reference);
    this.isOpen = true;
    this.refresh();
    await this.adjust();
  }

  private form(): HTMLElement {
    return h(
      "form",
      { onsubmit: (event) => this.submit(event) },
      this.heading,
      this.prompt,
      h("label", { for: "in-image" }, "Place in the image", h("span", { class: "quiet" }, " line, sample")),
      this.image,
      h("label", { for: "on-ground" }, "Place on the ground", h("span", { class: "quiet" }, " longitude, latitude, height above the ellipsoid")),
      this.ground,
      h("div", { class: "tools" }, h("button", { type: "submit" }, "Set"), h("button", { type: "button", onclick: () => this.giveUp() }, "Give up")),
    );
  }

  private fileField(): HTMLElement {
    return h("div", { class: "open-file" }, h("label", { for: "open-marks" }, "Open marks", h("span", { class: "quiet" }, " a CSV that was saved here")), this.file);
  }

  private shortcut(event: KeyboardEvent): void {
    if (!(event.ctrlKey || event.metaKey) || (event.target instanceof HTMLInputElement && event.target.value)) return;
    const key = event.key.toLowerCase();
    if (key === "z" && !event.shiftKey) this.back();
    else if (key === "y" || key === "z") this.forth();
    else return;
    event.preventDefault();
  }

  private back(): void {
    this.history.undo();
    this.changed("Undone.");
  }

  private forth(): void {
    this.history.redo();
    this.changed("Done again.");
  }

  private put(state: State, words: string): void {
    this.history.add(state);
    this.changed(words);
  }

  private replace(mark: Mark, by: Mark): void {
    this.put({ marks: this.marks.map((one) => (one === mark ? by : one)), begun: this.begun }, `${by.name} changed.`);
  }

  private changed(words: string): void {
    announce(words);
    fill(this.mistake);
    this.refresh();
    void this.adjust();
  }

  /** The place on the map, or the control point there with its height and sigmas. */
  private async chooseOnMap([lon, lat]: Position, point?: number): Promise<void> {
    this.isTyped = false;
    try {
      this.choose({ ground: point === undefined ? { lon: lon!, lat: lat!, height_m: null, sigma_m: null } : await pointOnGround(point, this.place.signal) });
    } catch (error) {
      this.refuse(error);
    }
  }

  /** Take a half of a mark, or both; a mark with both and a height is complete. */
  private choose(half: { image?: InImage; ground?: OnGround }): void {
    if (!this.isOpen) return;
    const begun: Begun = { ...this.begun, ...half };
    const { image, ground } = begun;
    const marks = this.completed(begun);
    if (marks !== this.marks) {
      this.put({ marks, begun: nothingBegun(marks) }, `${marks.at(-1)!.name} set.`);
      if (this.isTyped) this.ground.focus();
      return;
    }
    this.put({ marks: this.marks, begun }, half.image ? "Place in the image chosen." : half.ground?.point === undefined ? "Place on the ground chosen." : `Control point ${half.ground.point} chosen.`);
    if (image && ground) {
      this.ground.focus();
      this.ground.setSelectionRange(this.ground.value.length, this.ground.value.length);
    } else if (image) document.querySelector<HTMLElement>("#map canvas")?.focus({ preventScroll: true });
    else this.viewer.element.focus({ preventScroll: true });
  }

  /** Forget the half that is chosen; a mark that was to be changed stays as it was. */
  private giveUp(): void {
    const marks = this.completed();
    this.put({ marks, begun: nothingBegun(marks) }, "Given up.");
  }

  /** The marks, and one with both halves and a height: one that is being changed, or what was chosen last completes. */
  private completed({ image, ground, name, check } = this.begun): Mark[] {
    if (!image || !ground || this.lacksHeight(ground)) return this.marks;
    return [...this.marks, { ...ground, ...image, name: unlike(name, this.marks), check }];
  }

  private lacksHeight({ height_m }: OnGround): boolean {
    return height_m == null && this.terrain == null && this.model.needsHeights;
  }

  private submit(event: Event): void {
    event.preventDefault();
    try {
      const half: { image?: InImage; ground?: OnGround } = {};
      const { image, ground } = this.begun;
      if (this.image.value.trim() && this.image.value !== imageText(image)) half.image = shown(parseInImage(this.image.value), this.model);
      if (this.ground.value.trim() && this.ground.value !== groundText(ground)) half.ground = inOrder(parseOnGround(this.ground.value), this.outline);
      if (!half.image && !half.ground && this.completed() === this.marks) throw new Error(image && ground ? "A height is missing: add it after longitude and latitude." : "A place in the image or on the ground is missing.");
      this.isTyped ||= half.ground !== undefined;
      this.choose(half);
      if (half.ground) void this.place.atlas.goTo([half.ground.lon, half.ground.lat]);
    } catch (error) {
      this.refuse(error);
    }
  }

  private refuse(error: unknown): void {
    if (!this.place.signal.aborted) fill(this.mistake, problem(error));
  }

  /** Put the halves of a mark back to where they are chosen: the next choice replaces one of them. */
  private change(mark: Mark): void {
    const { name, check, line, sample, ...ground } = mark;
    const begun: Begun = { name, check, image: { line, sample }, ground };
    this.put({ marks: this.completed().filter((one) => one !== mark), begun }, `${name}: choose its place in the image or on the ground again.`);
    this.look(mark);
    this.image.focus();
  }

  /** Bring a mark into the middle of the image and of the map. */
  private look({ line, sample, lon, lat }: Mark): void {
    this.viewer.goTo({ at: pixel({ line, sample }), radius: AROUND_PX });
    void this.place.atlas.goTo([lon, lat]);
  }

  private goOn(): void {
    if (this.next?.line == null || this.next.sample == null) return;
    this.viewer.goTo({ at: pixel({ line: this.next.line, sample: this.next.sample }), radius: AROUND_PX });
    if (this.next.lon != null) void this.place.atlas.goTo([this.next.lon, this.next.lat!]);
    this.viewer.element.focus();
  }

  /** Show the marks, and the half that is chosen, everywhere. */
  private refresh(): void {
    const { marks, begun } = this;
    this.undo.disabled = !this.history.canUndo;
    this.redo.disabled = !this.history.canRedo;
    this.heading.textContent = `Mark ${begun.name}`;
    this.image.value = imageText(begun.image);
    this.ground.value = groundText(begun.ground);
    this.prompt.textContent = this.promptText();
    this.table.show(marks, this.results);
    this.drawMarks();
    void this.chip.show(begun.ground?.point);
  }

  private promptText(): string {
    const { image, ground } = this.begun;
    if (image && ground && this.lacksHeight(ground)) return "The height is missing: add it after longitude and latitude, in metres above the ellipsoid, then Set.";
    if (image && ground) return "Choose its place in the image or on the map again.";
    if (image) return "Now the same place on the map.";
    if (ground) return `${this.chosen}Now the same place in the image.`;
    return "Choose a place in the image or on the map.";
  }

  /** The control point that is chosen on the map, for the prompt. */
  private get chosen(): string {
    const point = this.begun.ground?.point;
    return point === undefined ? "" : `Control point ${point}. `;
  }

  private drawMarks(): void {
    const { marks, begun } = this;
    const marked = marks.map((mark): Marked => {
      const found = this.results.get(mark.name);
      const [line, sample] = found?.residual_px ?? [];
      const computed = line == null || sample == null ? null : pixel({ line: mark.line - line, sample: mark.sample - sample });
      return { name: mark.name, at: pixel(mark), computed, colour: found?.status === "rejected" ? "rejected" : mark.check ? "ofMap" : "drawn" };
    });
    if (begun.image) marked.push({ name: begun.name, at: pixel(begun.image), computed: null, colour: "begun" });
    this.viewer.show({ marked, expected: null });
    const features = marks.map((mark): Feature => {
      const colour = this.results.get(mark.name)?.status === "rejected" ? "rejected" : mark.check ? "check" : "used";
      return feature(mark, { name: mark.name, colour });
    });
    if (begun.ground) features.push(feature(begun.ground, { name: begun.name, colour: "begun" }));
    void this.place.atlas.show("marks", features);
    if (!begun.image) void this.place.atlas.show("target", []);
  }

  /** Let the service adjust the model on the marks; only the last of several requests counts. */
  private async adjust(): Promise<void> {
    sessionStorage.setItem(this.key, JSON.stringify({ state: this.history.now, stated: this.stated.value }));
    const { image, ground } = this.begun;
    const asked = image && !ground ? [image] : ground && !image ? [{ lon: ground.lon, lat: ground.lat, height_m: ground.height_m }] : [];
    this.request.abort();
    const request = (this.request = new AbortController());
    this.summary.setAttribute("aria-busy", "true");
    // A file has the heights of the reply.
    this.save.disabled = this.send.disabled = true;
    try {
      const reply = await this.ask(this.marks, asked, AbortSignal.any([request.signal, this.place.signal]));
      if (request.signal.aborted) return;
      this.results = new Map(reply.marks.map((mark) => [mark.name, mark]));
      this.next = reply.next_mark;
      this.table.show(this.marks, this.results);
      this.drawMarks();
      fill(this.summary, verdictOn(reply));
      fill(this.notes, ...notesOn(reply, this.model.needsHeights));
      this.onward.hidden = this.next?.line == null;
      this.save.disabled = this.send.disabled = this.marks.length === 0;
      if (reply.places[0]) this.expect(reply.places[0]);
    } catch (error) {
      if (request.signal.aborted || this.place.signal.aborted) return;
      this.results = new Map();
      this.table.show(this.marks, this.results);
      fill(this.summary, problem(error));
      fill(this.notes);
    }
    this.summary.setAttribute("aria-busy", "false");
  }

  private async ask(set: Mark[], places: object[], signal: AbortSignal = this.place.signal): Promise<AdjustedMarks> {
    const marks = set.map(({ point: _, ...mark }) => mark);
    const body = JSON.stringify({ marks, places, ...this.stated.value });
    const reply = await call(`jobs/${this.model.job}/marks`, { method: "POST", body, headers: { "Content-Type": "application/json" }, signal });
    const adjusted = (await reply.json()) as AdjustedMarks;
    this.terrain = adjusted.terrain;
    return adjusted;
  }

  /** Show where the other half of a mark is expected. */
  private expect({ line, sample, lon, lat, sigma_px: sigma }: PlaceOfMarks): void {
    const { atlas } = this.place;
    if (this.begun.image) {
      if (lon == null || lat == null) return;
      void atlas.goTo([lon, lat]);
      this.prompt.textContent = "Now the same place on the map: it is expected in the circle in its middle.";
      return;
    }
    const radius = CE90_SIGMAS * (sigma ?? AROUND_PX);
    if (line == null || sample == null || beyond({ line, sample }, this.model) > radius) {
      this.prompt.textContent = `${this.chosen}The image does not show this place.`;
      return;
    }
    const expected: Expected = { at: pixel({ line, sample }), radius };
    this.viewer.show({ expected });
    this.viewer.goTo({ ...expected, radius: Math.max(radius, AROUND_PX) });
    this.prompt.textContent = `${this.chosen}Now the same place in the image: it is expected in the circle of ${Math.max(radius, 1).toFixed(0)} px, at line ${line.toFixed(1)}, sample ${sample.toFixed(1)}.`;
  }

  private csv(): File {
    return new File([writeCsv(this.marks, this.results, this.stated.value)], FILE, { type: "text/csv" });
  }

  private download(): void {
    const href = URL.createObjectURL(this.csv());
    h("a", { href, download: FILE }).click();
    setTimeout(() => URL.revokeObjectURL(href), 10_000);
    announce(`${FILE} saved.`);
  }

  private async openFile(): Promise<void> {
    const [file] = this.file.files ?? [];
    if (!file) return;
    try {
      const { marks, mark_sigma_px } = readCsv(await file.text());
      if (mark_sigma_px != null) this.stated.value = { mark_sigma_px };
      this.put({ marks, begun: nothingBegun(marks) }, `${plural(marks.length, "mark")} opened.`);
    } catch (error) {
      this.refuse(error);
    }
    this.file.value = "";
  }

  private async register(): Promise<void> {
    this.send.disabled = true;
    try {
      const control = await uploadBeside(this.scene.id, this.csv());
      const { frame_sigma_m: frame } = this.stated.value;
      const inputs = { method: "marks", control, ...(frame ? { control_frame_sigma_m: frame } : {}) };
      go(`#/job/${await register(this.scene.id, inputs)}`);
    } catch (error) {
      this.refuse(error);
      this.send.disabled = false;
    }
  }
}

/** Zoom at which a pixel of the map is as large as one of so many degrees of a great circle at a latitude. */
function zoomOf(step_deg: number, lat: number): number {
  const step_m = (step_deg * 40_075_017) / 360;
  return Math.min(Math.log2((ZOOM_0_M * Math.cos(radians(lat))) / step_m), LARGEST_ZOOM);
}

function radians(degrees: number): number {
  return (degrees * Math.PI) / 180;
}

function pixel({ line, sample }: InImage): Pixel {
  return [sample + CENTRE, line + CENTRE];
}

function feature({ lon, lat }: OnGround, properties: object): Feature {
  return { type: "Feature", properties: { ...properties }, geometry: { type: "Point", coordinates: [lon, lat] } };
}
