// The tiles of a raw image, fetched by ranges of one file.

import { call, get } from "./api";
import type { ResultFile, StatusInfo } from "./api_types";
import { drawn } from "./processes";

const PROCESS = "view-scene";
const MOST_TILES = 300;

interface Level {
  lines: number;
  samples: number;
  /** Offset and size of each tile, row by row. */
  tiles: [number, number][];
}
export interface TileIndex {
  lines: number;
  samples: number;
  tile_px: number;
  levels: Level[];
}

/** The tiles of an image; those seen last stay in memory. */
export class Tiles {
  private readonly seen = new Map<string, ImageBitmap | null>();

  constructor(
    readonly index: TileIndex,
    private readonly file: string,
    private readonly signal: AbortSignal,
  ) {}

  /** The tile at a place of a level if it is there; else it is fetched, and `arrived` called. */
  tile(level: number, row: number, column: number, arrived: () => void): ImageBitmap | null {
    const key = `${level} ${row} ${column}`;
    const known = this.seen.get(key);
    if (known === undefined) void this.fetch(key, level, row, column).then(arrived, () => this.seen.delete(key));
    else {
      this.seen.delete(key);
      this.seen.set(key, known);
    }
    return known ?? null;
  }

  private async fetch(key: string, level: number, row: number, column: number): Promise<void> {
    this.seen.set(key, null);
    const { samples, tiles } = this.index.levels[level]!;
    const [offset, size] = tiles[row * Math.ceil(samples / this.index.tile_px) + column]!;
    const headers = { Accept: "*/*", Range: `bytes=${offset}-${offset + size - 1}` };
    const reply = await call(this.file, { headers, signal: this.signal });
    const content = await reply.arrayBuffer();
    // A storage that knows no ranges sends the whole file.
    const part = reply.status === 206 ? content : content.slice(offset, offset + size);
    this.seen.set(key, await createImageBitmap(new Blob([part], { type: "image/jpeg" })));
    if (this.seen.size > MOST_TILES) this.seen.delete(this.seen.keys().next().value!);
  }
}

/** The tiles of a scene: of an earlier job, or of a new one, whose state `report` gets. */
export async function tilesOf(scene: string, signal: AbortSignal, report: (job: StatusInfo) => void): Promise<Tiles> {
  const { results } = await drawn(PROCESS, { scene }, signal, report);
  const { href } = results["tiles.json"] as ResultFile;
  return new Tiles(await get<TileIndex>(href, signal), (results["tiles.bin"] as ResultFile).href, signal);
}
