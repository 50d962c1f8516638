"""Axes, units, signs and pixel origin of all data inside `services`. Read this module first.

**Image.** A position is `line_sample`, (n, 2) float64 pixels. (0, 0) is the *centre* of the first
pixel; lines grow downwards, samples to the right. The pixel `image[i, j]` covers lines
`i - 0.5 .. i + 0.5` and samples `j - 0.5 .. j + 0.5`. Files with another origin (GDAL counts from the
corner, DIMAP v2 from one) are converted in `amers.services.formats` and nowhere else.

**Ground.** A position is `lon_lat_h`, (n, 3): degrees, degrees, metres above the WGS 84 ellipsoid.
Heights above a geoid are named `orthometric_height_m`.
`ecef` is (n, 3) metres, Earth-centred and Earth-fixed; `east_north_up` is (n, 3) metres in the frame
tangent to the ellipsoid at a named origin.

**Models.** `project` goes from the ground to the image, `locate` from the image to the ground at a
known height, `intersect` from the rays of several images to one ground point.

**Chips.** `CHIP_SIZE` x `CHIP_SIZE` pixels, north up, on the horizontal plane through the point. Pixel
`(r, c)` of a chip with ground sampling `g` lies at east `(c - CHIP_CENTRE) g` and north
`(CHIP_CENTRE - r) g` metres of the point, along the axes of the point's own east-north-up frame.

**Statistics.** `sigma_*` is known a priori, `std_*` is estimated a posteriori; both are one standard
deviation. A residual is observed minus computed. Angles are in degrees in data and in radians inside
formulas. Azimuths count clockwise from north; `azimuth_deg` of a view points from the ground to the
sensor.

**Missing values** are NaN in float arrays, with a separate status where the reason matters.
"""

STATUS_COLOURS = {"active": "#2f7ed8", "deactivated": "#e8862e", "not matched": "#8b939c"}
"""Colours of points by their status in a registration, in reports and in layers of vectors."""

CHIP_SIZE = 101
"""Lines and samples of a chip."""
CHIP_CENTRE = 50
"""Row and column of the point in its chip."""

MAX_ERROR_SIGMAS = 3.0
"""Largest error that is expected, in standard deviations. A model may be wrong by this many times its
sigma: search radii, margins and footprints reach that far."""
