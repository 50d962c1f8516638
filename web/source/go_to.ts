// Go to a coordinate, a country or a town: one field on the map.

import type { Feature, FeatureCollection, Point, Position } from "geojson";
import { get } from "./api";
import { h, problem } from "./elements";
import { degrees } from "./graticule";
import { announce } from "./page";

/** A country with the box of its largest part, or a town, which has none. */
type Named = Feature<Point, { name: string; box?: [west: number, south: number, east: number, north: number] }>;

export const COUNTRIES = "map/countries.json";
/** Towns of 20,000 inhabitants or more, the largest first. */
export const TOWNS = "map/towns.json";
const NUMBER = "([+-]?\\d+(?:\\.\\d+)?)\\s*°?\\s*([NSEW]?)";
const COORDINATE = new RegExp(`^${NUMBER}[\\s,;]+${NUMBER}$`);

/** The field; it moves the map to a position, or to a box with its corners. */
export function goToField(toPosition: (position: Position) => void, toBox: (corners: Position[]) => void): HTMLElement {
  const names = h("datalist", { id: "countries" });
  const message = h("div");
  const input = h("input", {
    type: "search",
    id: "go-to",
    list: "countries",
    placeholder: "48.85, 2.35 or a place",
    enterkeyhint: "go",
    autocomplete: "off",
    onfocus: () => void named(COUNTRIES).then(offer, () => undefined),
  });
  return h("form", { class: "go-to", role: "search", onsubmit: (event) => void submit(event) }, h("label", { for: "go-to" }, "Go to"), input, names, message);

  function offer(found: Named[]): void {
    if (!names.children.length) names.append(...found.map(({ properties: { name } }) => h("option", { value: name })));
  }

  async function submit(event: Event): Promise<void> {
    event.preventDefault();
    const text = input.value.trim();
    message.replaceChildren();
    const position = coordinate(text);
    if (position) {
      toPosition(position);
      announce(`The map shows ${degrees(position[1]!, "N", "S", 4)}, ${degrees(position[0]!, "E", "W", 4)}.`);
      return;
    }
    const lists = await Promise.all([COUNTRIES, TOWNS].map((list) => named(list).catch(() => [])));
    const found = text ? find(lists.flat(), text) : undefined;
    if (!found) {
      message.append(
        problem(`“${text}” is no country, no town that the map names and no coordinate. Write latitude, then longitude, in degrees, as in 48.85, 2.35.`),
      );
      return;
    }
    const { box, name } = found.properties;
    if (box) toBox([box.slice(0, 2), box.slice(2)]);
    else toPosition(found.geometry.coordinates);
    announce(`The map shows ${name}.`);
  }
}

/** Longitude and latitude of a text; latitude comes first where no letter tells them apart. Null if it is none. */
export function coordinate(text: string): Position | null {
  const [, first = "", one = "", second = "", other = ""] = COORDINATE.exec(text.toUpperCase()) ?? [];
  const longitudeFirst = /[EW]/.test(one) || /[NS]/.test(other);
  if (!first || (longitudeFirst && (/[NS]/.test(one) || /[EW]/.test(other)))) return null;
  const angles = [signed(first, one), signed(second, other)];
  const [longitude, latitude] = (longitudeFirst ? angles : angles.reverse()) as [number, number];
  return Math.abs(longitude) <= 180 && Math.abs(latitude) <= 90 ? [longitude, latitude] : null;
}

function signed(number: string, letter: string): number {
  return /[SW]/.test(letter) ? -Number(number) : Number(number);
}

async function named(list: string): Promise<Named[]> {
  return (await get<FeatureCollection & { features: Named[] }>(list)).features;
}

/** The first place of a name, or the first whose name begins with the text, or contains it. */
function find(places: Named[], text: string): Named | undefined {
  const wanted = plain(text);
  const matches: ((name: string) => boolean)[] = [(name) => name === wanted, (name) => name.startsWith(wanted), (name) => name.includes(wanted)];
  for (const match of matches) {
    const place = places.find(({ properties: { name } }) => match(plain(name)));
    if (place) return place;
  }
  return undefined;
}

/** A name without accents and capitals. */
function plain(name: string): string {
  return name.normalize("NFD").replace(/\p{M}/gu, "").toLowerCase();
}
