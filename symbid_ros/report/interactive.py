"""Data and script of the figures that readers can zoom; see report.js."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.report.content import ReportContent
from symbid_ros.report.log_figures import (
    binned_medians,
    broken,
    drawn_forces,
    force_range,
    pauses,
    shown_error,
    shown_joints,
)

_FOLDER = Path(__file__).parent
_VENDOR = _FOLDER / "vendored"


def figure_data(content: ReportContent) -> dict[str, Any]:
    """Return what report.js draws; arrays are little-endian float32 in base64."""
    data: dict[str, Any] = {}
    if (forces := drawn_forces(content.shown.drawn)) is not None:
        amplitudes = [
            np.sqrt(power)
            for power in (forces.power_measured, forces.power_before, forces.power_after)
        ]
        gaps = pauses(forces.time)
        data |= {
            "time": packed(
                np.insert(forces.time, gaps, (forces.time[gaps - 1] + forces.time[gaps]) / 2)
            ),
            "frequency": packed(forces.frequency),
            "first": int(shown_joints(forces)[0]),
            "coordinates": [
                {
                    "name": name,
                    "unit": forces.units[place],
                    "measured": packed(broken(forces.measured[:, place], gaps)),
                    "before": packed(broken(forces.before[:, place], gaps)),
                    "after": packed(broken(forces.after[:, place], gaps)),
                    "limit": shown_error(forces, place),
                    "range": force_range(forces, place),
                    "spectra": [packed(one[:, place]) for one in amplitudes],
                    "speed": _speeds(forces.speed[:, place]),
                    "speedBefore": packed(forces.speed_before[:, place]),
                    "speedAfter": packed(forces.speed_after[:, place]),
                    "medians": [
                        packed(one)
                        for errors in (forces.speed_before, forces.speed_after)
                        for one in binned_medians(forces.speed[:, place], errors[:, place])
                    ],
                    "index": place,
                }
                for place, name in enumerate(forces.coordinates)
                if forces.has_rows[place]
            ],
        }
    if content.spread is not None:
        spread = content.spread
        data["correlation"] = {
            "names": list(spread.names),
            "values": base64.b64encode(
                np.round(100 * spread.correlation).astype(np.int8).tobytes()
            ).decode(),
        }
    return data


def _speeds(speed: FloatArray) -> str | None:
    return packed(speed) if np.isfinite(speed).any() else None


def packed(values: FloatArray) -> str:
    """Return an array as base64."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def script_json(data: dict[str, Any]) -> str:
    """Return JSON for a script element, which the text ``</script`` would end."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def figure_script() -> str:
    """Return the script of the figures together with the library that it uses."""
    library = (_VENDOR / "uPlot.iife.min.js").read_text(encoding="utf-8")
    return f"{library}\n{(_FOLDER / 'report.js').read_text(encoding='utf-8')}"


def figure_css() -> str:
    """Return the style of the library."""
    return (_VENDOR / "uPlot.min.css").read_text(encoding="utf-8")
