"""Table of the attitude changes of a satellite over time (CSV)."""

import csv
import io

from amers.services.sensors.moving_pushbroom import AttitudeMotion

ATTITUDE_CSV = "attitude.csv"
_HEADINGS = "line", "time_s", "roll_urad", "pitch_urad"


def format_attitude(motion: AttitudeMotion) -> str:
    """A row for each line at which the turns are known; straight lines between them.

    Lines as scanned, seconds of the delivered model (after midnight UTC), microradians about the axes
    forwards and to the right of the line of sight of the central detector.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_HEADINGS)
    for line, time_s, (roll, pitch) in zip(
        motion.line, motion.time_s, 1e6 * motion.roll_pitch_rad, strict=True
    ):
        table.writerow([f"{line:.3f}", f"{time_s:.6f}", f"{roll:.4f}", f"{pitch:.4f}"])
    return text.getvalue()
