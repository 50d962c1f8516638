// Marks in a scene: ground points that a person sets in the raw image and on the map, their history and their file.

import type { AdjustedMark } from "./api_types";

/** A place in the image; the centre of the first pixel is line 0, sample 0. */
export interface InImage {
  line: number;
  sample: number;
}

/** A place on the ground; without a height it has that of the service's terrain. */
export interface OnGround {
  lon: number;
  lat: number;
  /** Above the ellipsoid. */
  height_m: number | null;
  /** Horizontal and up, one standard deviation; null, for both or one of them, for that of all marks. */
  sigma_m: [number | null, number | null] | null;
  /** Number of the control point that was chosen. */
  point?: number;
}

export interface Mark extends InImage, OnGround {
  name: string;
  check: boolean;
}

/** A mark of which a half, or the height, is missing. */
export interface Begun {
  name: string;
  check: boolean;
  image: InImage | null;
  ground: OnGround | null;
}

/** What is undone and done again. */
export interface State {
  marks: Mark[];
  begun: Begun;
}

/** What is stated of all marks that state nothing themselves, as the service takes it. */
export interface Stated {
  sigma_m?: [number, number];
  mark_sigma_px?: number;
  frame_sigma_m?: [number, number];
}

const MOST_STEPS = 500;
const ORIGIN = "# pixel-origin=centre heights=ellipsoid";
const COLUMNS = ["id", "lon", "lat", "height_m", "sigma_horizontal_m", "sigma_up_m", "line", "sample", "sigma_px", "check"] as const;
const ELSEWHERE = "The form at the scene takes files of every format.";
const NEEDED = ["lon", "lat", "line", "sample"] as const;

/** The first name that no mark has. */
export function nextName(marks: Mark[]): string {
  const names = new Set(marks.map(({ name }) => name));
  for (let number = 1; ; number++) if (!names.has(`M${number}`)) return `M${number}`;
}

export function nothingBegun(marks: Mark[]): Begun {
  return { name: nextName(marks), check: false, image: null, ground: null };
}

/** States one after another; a new one after an undo takes the place of those that were undone. */
export class History {
  private states: State[];
  private at = 0;

  constructor(first: State) {
    this.states = [first];
  }

  get now(): State {
    return this.states[this.at]!;
  }

  get canUndo(): boolean {
    return this.at > 0;
  }

  get canRedo(): boolean {
    return this.at < this.states.length - 1;
  }

  add(state: State): void {
    this.states = [...this.states.slice(0, this.at + 1), state].slice(-MOST_STEPS);
    this.at = this.states.length - 1;
  }

  undo(): void {
    if (this.canUndo) this.at -= 1;
  }

  redo(): void {
    if (this.canRedo) this.at += 1;
  }
}

/** Numbers of a text that commas, semicolons or spaces separate; null where a part is none. */
export function numbers(text: string): number[] | null {
  const parts = text.trim().split(/[\s,;]+/).filter(Boolean);
  const values = parts.map((part) => Number(part.replace("−", "-").replace(/°$/, "")));
  return values.every(Number.isFinite) ? values : null;
}

/** Line and sample of a text. */
export function parseInImage(text: string): InImage {
  const found = numbers(text);
  if (found?.length !== 2) throw new Error(`Place in the image: “${text}” found; line, sample expected, such as 1204.5, 3310.`);
  return { line: found[0]!, sample: found[1]! };
}

/** Longitude, latitude and perhaps height of a text. */
export function parseOnGround(text: string): OnGround {
  const found = numbers(text);
  const [lon = NaN, lat = NaN, height_m = null] = found ?? [];
  const fits = found && found.length >= 2 && found.length <= 3 && Math.abs(lon) <= 180 && Math.abs(lat) <= 90;
  if (!fits) throw new Error(`Place on the ground: “${text}” found; longitude, latitude and perhaps height expected, in degrees and metres, such as 5.25331, 43.25242, 120.`);
  return { lon, lat, height_m, sigma_m: null };
}

/** The file that `amers scene register --control` reads: what was stated, and heights that the service has found. */
export function writeCsv(marks: Mark[], results: Map<string, AdjustedMark>, stated: Stated): string {
  const rows = marks.map((mark) => {
    const found = results.get(mark.name);
    const [horizontal, up] = [0, 1].map((axis) => mark.sigma_m?.[axis] ?? stated.sigma_m?.[axis]);
    // The sigma of a height of the terrain is that of the terrain.
    const ofTerrain = mark.height_m == null ? found?.sigma_m[2] : null;
    const values: Record<(typeof COLUMNS)[number], string | number | null | undefined> = {
      id: mark.name,
      lon: mark.lon,
      lat: mark.lat,
      height_m: mark.height_m ?? found?.height_m,
      sigma_horizontal_m: horizontal,
      sigma_up_m: ofTerrain ?? up,
      line: mark.line,
      sample: mark.sample,
      sigma_px: stated.mark_sigma_px,
      check: mark.check ? 1 : 0,
    };
    return COLUMNS.map((column) => values[column] ?? "").join(",");
  });
  return [ORIGIN, COLUMNS.join(","), ...rows, ""].join("\n");
}

/** The marks of a file that `writeCsv` wrote, or one with its first line and some of its columns, and the sigma of all picks. */
export function readCsv(text: string): { marks: Mark[]; mark_sigma_px: number | null } {
  const lines = text.split(/\r?\n/).filter((line) => line.trim());
  const comments = lines.filter((line) => line.startsWith("#")).join(" ");
  const [head = "", ...rows] = lines.filter((line) => !line.startsWith("#"));
  const columns = head.split(",").map((column) => column.trim());
  refuseOther(columns, comments);
  const marks: Mark[] = [];
  const picks = new Set<number | null>();
  for (const [number, row] of rows.entries()) {
    const fields = row.split(",").map((field) => field.trim());
    const field = (column: (typeof COLUMNS)[number]): string => fields[columns.indexOf(column)] ?? "";
    const value = (column: (typeof COLUMNS)[number]): number | null => {
      if (field(column) && !Number.isFinite(Number(field(column)))) throw new Error(`Row ${number + 1}: ${column}: “${field(column)}” found, a number expected.`);
      return field(column) ? Number(field(column)) : null;
    };
    const [lon, lat, line, sample] = NEEDED.map(value);
    if (lon == null || lat == null || line == null || sample == null) throw new Error(`Row ${number + 1}: ${NEEDED.join(", ")} expected, found an empty field.`);
    const sigma_m: [number | null, number | null] = [value("sigma_horizontal_m"), value("sigma_up_m")];
    const check = ["1", "true", "yes"].includes(field("check").toLowerCase());
    marks.push({ name: unlike(field("id"), marks), line, sample, lon, lat, height_m: value("height_m"), sigma_m, check });
    picks.add(value("sigma_px"));
  }
  if (picks.size > 1) throw new Error(`Column sigma_px: ${picks.size} values found, one for all marks expected. ${ELSEWHERE}`);
  return { marks, mark_sigma_px: [...picks][0] ?? null };
}

/** Refuse a file whose columns or conventions are others. */
function refuseOther(columns: string[], comments: string): void {
  const missing = NEEDED.filter((column) => !columns.includes(column));
  const unknown = columns.filter((column) => !(COLUMNS as readonly string[]).includes(column));
  if (missing.length || unknown.length) {
    throw new Error(`Columns ${columns.join(", ").slice(0, 80)} found; expected ${NEEDED.join(", ")}, and of ${COLUMNS.join(", ")} no others. ${ELSEWHERE}`);
  }
  if (!/pixel-origin\s*[=:]\s*centre\b/i.test(comments) || !/heights\s*[=:]\s*ellipsoid/i.test(comments)) {
    throw new Error(`A first line “${ORIGIN}” expected: it says what line and height mean. ${ELSEWHERE}`);
  }
}

/** A name for a file and for a list: without separators, and unlike those of other marks. */
export function unlike(name: string, others: Mark[]): string {
  const plain = name.replace(/[\s,;"#]+/g, " ").trim().slice(0, 100);
  return plain && !others.some((other) => other.name === plain) ? plain : nextName(others);
}
