// The raw image on a canvas: moved and magnified with pointer, wheel and keys, and drawn on.

import type { Feature } from "geojson";
import { h } from "./elements";
import { type Kind, KINDS, paths, type Pixel } from "./shapes";
import type { Tiles } from "./tiles";

const STEP_PX = 12;
const FINE_STEP_PX = 1;
const DRAG_PX = 4;
/** From the edge of a pixel of the screen, as a click has it, to its middle. */
const MIDDLE_PX = 0.5;
const ZOOM = 1.5;
const LARGEST_SCALE = 16;
const EDGE_PX = 24;
const COLOURS = { drawn: "#ffd60a", begun: "#ff9f0a", ofMap: "#4cc9f0", halo: "#000000b0", rejected: "#ff7b72" };
const OF_SHAPES =
  "Raw image. Arrow keys move the crosshair, space sets a vertex, Enter ends the shape, Backspace takes the last vertex back, plus and minus magnify.";
/** Smallest circle around an expected place, and the share of the view that a circle has when the image is moved to it. */
const LEAST_RADIUS_PX = 12;
const EXPECTED_SHARE = 0.3;

/** A place that was marked, with where the model computes it. */
export interface Marked {
  name: string;
  at: Pixel;
  computed: Pixel | null;
  colour: "drawn" | "begun" | "ofMap" | "rejected";
}
/** A place that the model expects, within a radius in pixels of the image. */
export interface Expected {
  at: Pixel;
  radius: number;
}

export interface Seen {
  /** Shapes that were drawn, and vectors of the map, in pixels. */
  drawn: Feature[];
  ofMap: Feature[];
  marked: Marked[];
  expected: Expected | null;
}

/** The view of a raw image; `finished` gets every shape that was drawn to its end. */
export class Viewer {
  readonly element: HTMLCanvasElement;
  kind: Kind = "Point";
  private seen: Seen = { drawn: [], ofMap: [], marked: [], expected: null };
  private begun: Pixel[] = [];
  private pointer: Pixel | null = null;
  /** Screen position of the crosshair that the keys move; null until one does. */
  private cross: Pixel | null = null;
  private centre: Pixel;
  private scale = 1;
  private drag: { at: Pixel; moved: boolean } | null = null;
  private waiting = false;

  constructor(
    container: HTMLElement,
    private readonly tiles: Tiles,
    private readonly finished: (kind: Kind, vertices: Pixel[]) => void,
    signal: AbortSignal,
    label = OF_SHAPES,
  ) {
    this.element = h("canvas", { tabindex: 0, role: "application", "aria-label": label });
    const magnify = (text: string, name: string, factor: number): HTMLElement =>
      h("button", { type: "button", "aria-label": name, onclick: () => this.magnify(factor) }, text);
    container.replaceChildren(this.element, h("div", { class: "magnify" }, magnify("+", "Magnify", ZOOM), magnify("−", "Reduce", 1 / ZOOM)));
    const { lines, samples } = tiles.index;
    this.centre = [samples / 2, lines / 2];
    this.scale = this.smallestScale();
    const sized = new ResizeObserver(() => this.resize());
    sized.observe(this.element);
    signal.addEventListener("abort", () => sized.disconnect());
    this.listen();
  }

  /** Replace what is shown on the image. */
  show(seen: Partial<Seen>): void {
    this.seen = { ...this.seen, ...seen };
    this.draw();
  }

  /** Draw another kind of shape; one that was begun is given up. */
  choose(kind: Kind): void {
    this.kind = kind;
    this.begun = [];
    this.draw();
  }

  /** End the shape that was begun, if it has enough vertices. */
  finish(): void {
    if (this.begun.length < KINDS[this.kind].fewest) return;
    const vertices = this.begun;
    this.begun = [];
    this.finished(this.kind, vertices);
    this.draw();
  }

  /** Move the image so that an expected place is in the middle, as large as its radius allows. */
  goTo({ at, radius }: Expected): void {
    this.centre = at;
    const { clientWidth, clientHeight } = this.element;
    const fitting = (EXPECTED_SHARE * Math.min(clientWidth, clientHeight)) / Math.max(radius, LEAST_RADIUS_PX);
    this.scale = Math.min(Math.max(fitting, this.smallestScale()), LARGEST_SCALE / 4);
    this.cross = null;
    this.draw();
  }

  private listen(): void {
    const canvas = this.element;
    canvas.addEventListener("pointerdown", (event) => {
      this.drag = { at: [event.offsetX, event.offsetY], moved: false };
      this.cross = null;
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => this.move([event.offsetX, event.offsetY]));
    canvas.addEventListener("pointerup", (event) => {
      const click = this.drag && !this.drag.moved;
      this.drag = null;
      if (click) this.add([event.offsetX + MIDDLE_PX, event.offsetY + MIDDLE_PX]);
    });
    canvas.addEventListener("pointercancel", () => (this.drag = null));
    canvas.addEventListener("pointerleave", () => this.move(null));
    canvas.addEventListener("dblclick", () => this.endTwice());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.magnify(event.deltaY < 0 ? ZOOM : 1 / ZOOM, [event.offsetX, event.offsetY]);
    });
    canvas.addEventListener("keydown", (event) => {
      if (this.key(event.key, event.shiftKey)) event.preventDefault();
    });
  }

  /** Whether a key means something here. */
  private key(key: string, fine: boolean): boolean {
    const step = fine ? FINE_STEP_PX : STEP_PX;
    const steps: Record<string, Pixel> = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    const actions: Record<string, () => void> = {
      " ": () => this.add(this.crosshair()),
      Enter: () => (this.kind === "Point" ? this.add(this.crosshair()) : this.finish()),
      Backspace: () => void this.begun.pop(),
      Escape: () => (this.begun = []),
      "+": () => this.magnify(ZOOM, this.crosshair()),
      "=": () => this.magnify(ZOOM, this.crosshair()),
      "-": () => this.magnify(1 / ZOOM, this.crosshair()),
    };
    const way = steps[key];
    if (way) this.moveCrosshair(way);
    else if (actions[key]) actions[key]();
    else return false;
    this.draw();
    return true;
  }

  private crosshair(): Pixel {
    return (this.cross ??= [this.element.clientWidth / 2, this.element.clientHeight / 2]);
  }

  /** The crosshair stays away from the border; the image moves instead. */
  private moveCrosshair([dx, dy]: Pixel): void {
    const [x, y] = this.crosshair();
    const inside = (at: number, size: number): number => Math.min(Math.max(at, EDGE_PX), size - EDGE_PX);
    const to: Pixel = [inside(x + dx, this.element.clientWidth), inside(y + dy, this.element.clientHeight)];
    this.pan(x + dx - to[0], y + dy - to[1]);
    this.cross = to;
  }

  private move(at: Pixel | null): void {
    this.pointer = at;
    if (at && this.drag) {
      const [x, y] = this.drag.at;
      if (this.drag.moved || Math.hypot(at[0] - x, at[1] - y) > DRAG_PX) {
        this.pan(x - at[0], y - at[1]);
        this.drag = { at, moved: true };
      }
    }
    this.draw();
  }

  private pan(dx: number, dy: number): void {
    const { lines, samples } = this.tiles.index;
    const within = (at: number, size: number): number => Math.min(Math.max(at, 0), size);
    this.centre = [within(this.centre[0] + dx / this.scale, samples), within(this.centre[1] + dy / this.scale, lines)];
  }

  /** Magnify around a place of the screen, by default its middle. */
  private magnify(factor: number, around?: Pixel): void {
    const [x, y] = around ?? [this.element.clientWidth / 2, this.element.clientHeight / 2];
    const before = this.toImage([x, y]);
    this.scale = Math.min(Math.max(this.scale * factor, this.smallestScale()), LARGEST_SCALE);
    const after = this.toImage([x, y]);
    this.pan((before[0] - after[0]) * this.scale, (before[1] - after[1]) * this.scale);
    this.draw();
  }

  /** The whole image, with a border. */
  private smallestScale(): number {
    const { lines, samples } = this.tiles.index;
    return 0.95 * Math.min(Math.max(this.element.clientWidth, 1) / samples, Math.max(this.element.clientHeight, 1) / lines);
  }

  private add(at: Pixel): void {
    const { lines, samples } = this.tiles.index;
    const [x, y] = this.toImage(at);
    if (x < 0 || y < 0 || x > samples || y > lines) return;
    this.begun.push([x, y]);
    if (this.kind === "Point") this.finish();
    this.draw();
  }

  /** A double click has set its place twice. */
  private endTwice(): void {
    if (this.kind === "Point" || this.begun.length < 2) return;
    this.begun.pop();
    this.finish();
  }

  private toImage([x, y]: Pixel): Pixel {
    return [this.centre[0] + (x - this.element.clientWidth / 2) / this.scale, this.centre[1] + (y - this.element.clientHeight / 2) / this.scale];
  }

  private toScreen([x, y]: number[]): Pixel {
    return [(x! - this.centre[0]) * this.scale + this.element.clientWidth / 2, (y! - this.centre[1]) * this.scale + this.element.clientHeight / 2];
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.element;
    if (!clientWidth || !clientHeight) return;
    const whole = this.element.width === 300 || this.scale < this.smallestScale();
    this.element.width = clientWidth * devicePixelRatio;
    this.element.height = clientHeight * devicePixelRatio;
    if (whole) this.scale = this.smallestScale();
    this.draw();
  }

  /** Draw once before the next frame, however often it is asked for. */
  private draw(): void {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.paint();
    });
  }

  private paint(): void {
    const context = this.element.getContext("2d")!;
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, this.element.clientWidth, this.element.clientHeight);
    context.imageSmoothingEnabled = this.scale < 2;
    const { levels } = this.tiles.index;
    const level = Math.min(Math.max(Math.floor(-Math.log2(this.scale * devicePixelRatio)), 0), levels.length - 1);
    const complete = this.paintLevel(context, levels.length - 1) && (level === levels.length - 1 || this.paintLevel(context, level));
    this.element.setAttribute("aria-busy", String(!complete));
    for (const { geometry } of this.seen.ofMap) this.paintPaths(context, paths(geometry), COLOURS.ofMap);
    for (const { geometry } of this.seen.drawn) this.paintPaths(context, paths(geometry), COLOURS.drawn);
    const end = this.cross ?? this.pointer;
    const begun = [...this.begun, ...(end && this.begun.length ? [this.toImage(end)] : [])];
    if (begun.length) this.paintPaths(context, [begun], COLOURS.begun);
    this.paintMarks(context);
    if (this.cross) this.paintCrosshair(context, this.cross);
  }

  /** Draw the tiles of a level that are in view; whether all of them were there. */
  private paintLevel(context: CanvasRenderingContext2D, level: number): boolean {
    const { index } = this.tiles;
    const { lines, samples } = index.levels[level]!;
    const side = index.tile_px * 2 ** level;
    const [west, north] = this.toImage([0, 0]);
    const [east, south] = this.toImage([this.element.clientWidth, this.element.clientHeight]);
    const last = (size: number): number => Math.ceil(size / index.tile_px) - 1;
    let complete = true;
    for (let row = Math.max(Math.floor(north / side), 0); row <= Math.min(Math.floor(south / side), last(lines)); row++) {
      for (let column = Math.max(Math.floor(west / side), 0); column <= Math.min(Math.floor(east / side), last(samples)); column++) {
        const tile = this.tiles.tile(level, row, column, () => this.draw());
        complete &&= tile !== null;
        if (!tile) continue;
        const [x, y] = this.toScreen([column * side, row * side]);
        const size = 2 ** level * this.scale;
        context.drawImage(tile, x, y, tile.width * size, tile.height * size);
      }
    }
    return complete;
  }

  private paintPaths(context: CanvasRenderingContext2D, lines: number[][][], colour: string): void {
    for (const line of lines) {
      const places = line.map((position) => this.toScreen(position));
      const path = new Path2D();
      places.forEach(([x, y], at) => (at ? path.lineTo(x, y) : path.moveTo(x, y)));
      this.stroke(context, path, colour);
      context.fillStyle = colour;
      context.lineWidth = 1;
      context.strokeStyle = COLOURS.halo;
      for (const [x, y] of places) {
        context.beginPath();
        context.arc(x, y, places.length === 1 ? 5 : 3, 0, 2 * Math.PI);
        context.fill();
        context.stroke();
      }
    }
  }

  private paintMarks(context: CanvasRenderingContext2D): void {
    context.font = "600 13px system-ui, sans-serif";
    const { marked, expected } = this.seen;
    for (const { name, at, computed, colour } of marked) {
      if (computed) this.paintPaths(context, [[at, computed]], COLOURS[colour]);
      const [x, y] = this.toScreen(at);
      this.stroke(context, new Path2D(`M${x - 9} ${y}h6M${x + 3} ${y}h6M${x} ${y - 9}v6M${x} ${y + 3}v6`), COLOURS[colour]);
      context.lineWidth = 4;
      context.strokeStyle = COLOURS.halo;
      context.strokeText(name, x + 8, y - 8);
      context.fillStyle = COLOURS[colour];
      context.fillText(name, x + 8, y - 8);
    }
    if (!expected) return;
    const circle = new Path2D();
    circle.arc(...this.toScreen(expected.at), Math.max(expected.radius * this.scale, LEAST_RADIUS_PX), 0, 2 * Math.PI);
    context.setLineDash([6, 4]);
    this.stroke(context, circle, COLOURS.begun);
    context.setLineDash([]);
  }

  /** A line with a dark border, which is seen on any image. */
  private stroke(context: CanvasRenderingContext2D, path: Path2D, colour: string): void {
    for (const [width, style] of [[4, COLOURS.halo], [2, colour]] as const) {
      context.lineWidth = width;
      context.strokeStyle = style;
      context.stroke(path);
    }
  }

  private paintCrosshair(context: CanvasRenderingContext2D, [x, y]: Pixel): void {
    this.stroke(context, new Path2D(`M${x - 14} ${y}h10M${x + 4} ${y}h10M${x} ${y - 14}v10M${x} ${y + 4}v10`), COLOURS.begun);
  }
}
