// Lengths on the ground in degrees, on the ellipsoid WGS 84.

const SEMI_MAJOR_M = 6_378_137;
const ECCENTRICITY_2 = 0.00669437999014;

/** Metres of a degree to the east and to the north at a latitude, on the ellipsoid. */
export function metresPerDegree(latitude: number): { east: number; north: number } {
  const angle = (latitude * Math.PI) / 180;
  const flattened = 1 - ECCENTRICITY_2 * Math.sin(angle) ** 2;
  const perRadian = SEMI_MAJOR_M / Math.sqrt(flattened);
  const degree = Math.PI / 180;
  return { east: degree * perRadian * Math.cos(angle), north: (degree * perRadian * (1 - ECCENTRICITY_2)) / flattened };
}

/** 1, 2 or 5 times a power of ten, not above the value. */
export function roundNumber(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  const digit = value / power;
  return (digit >= 5 ? 5 : digit >= 2 ? 2 : 1) * power;
}
