"""An animated SVG of robots side by side, seen from their right."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.learning.lockstep import PERIOD, SAMPLE_EVERY, LearningRecord
from symbid_ros.model.rotation import rotation_from_quaternion
from symbid_ros.model.tree import RobotModel

FRAME = 0.1  # s
AFTER = 1.4  # s that are shown after a fall
PIXELS = 230.0  # per metre
PANEL = 260.0, 390.0  # width and height
FLOOR = 345.0  # from the top
TRUNK = 0.35  # m above the base
FOOT = (-0.07, 0.14)  # m along the sole
# A page or a README may be dark.
STYLE = (
    "text{font:15px system-ui,sans-serif;fill:#3a3a3a}.quiet{fill:#767676;font-size:13px}"
    ".floor{stroke:#8a8a8a}.far{opacity:.45}"
    "@media(prefers-color-scheme:dark){text{fill:#e4e4e4}.quiet{fill:#a3a7ac}}"
)


@dataclass(frozen=True)
class Actor:
    """One robot of the animation: its motion, colour, and the caption of its outcome.

    The caption appears at the time ``since``, s.
    """

    record: LearningRecord
    colour: str
    caption: str
    since: float


def animation(
    model: RobotModel, soles: Sequence[str], actors: Mapping[str, Actor], start: float, stop: float
) -> str:
    """Return an SVG in which robots move side by side, and which repeats.

    Parameters
    ----------
    model : RobotModel
        Kinematics.
    soles : sequence of str
        Frames of the soles.
    actors : mapping of str to Actor
        By title.
    start, stop : float
        Time that is shown, s; a robot that falls stays where it is.
    """
    width, height = PANEL[0] * len(actors), PANEL[1]
    count = round((stop - start) / FRAME)
    seconds = count * FRAME
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'role="img" aria-label="{escape(" and ".join(actors))}"><style>{STYLE}</style>'
    ]
    times: FloatArray = start + FRAME * np.arange(count, dtype=np.float64)
    for place, (title, actor) in enumerate(actors.items()):
        left = place * PANEL[0]
        parts.append(f'<g transform="translate({left:g} 0)">')
        parts.append(
            f'<path class="floor" d="M20 {FLOOR + 4:g}H{PANEL[0] - 20:g}" stroke-width="2"/>'
        )
        parts.append(f'<text x="130" y="24" text-anchor="middle">{escape(title)}</text>')
        parts += _robot(model, soles, actor, times, seconds)
        parts.append(
            f'<text x="130" y="{height - 18:g}" text-anchor="middle">'
            f"{escape(actor.caption)}{_shown(actor.since - start, seconds, seconds)}</text>"
        )
        parts.append("</g>")
    for second in range(int(start), int(np.ceil(stop))):
        begin, end = max(second - start, 0.0), min(second + 1 - start, seconds)
        parts.append(
            f'<text x="{width / 2:g}" y="{height - 18:g}" class="quiet" text-anchor="middle">'
            f"{second} s{_shown(begin, end, seconds)}</text>"
        )
    # A bar that fills as time passes.
    parts.append(
        f'<rect x="20" y="{height - 6:g}" height="3" width="0" fill="#8a8a8a">'
        f'<animate attributeName="width" from="0" to="{width - 40:g}" dur="{seconds:g}s" '
        'repeatCount="indefinite"/></rect>'
    )
    parts.append("</svg>")
    return "".join(parts) + "\n"


def _shown(begin: float, end: float, seconds: float) -> str:
    """Return the animation of an element that is shown from ``begin`` to ``end`` of ``seconds``."""
    values, times = ["1"], ["0"]
    if begin > 0:
        values, times = ["0", "1"], ["0", f"{begin / seconds:.4f}"]
    if end < seconds:
        values.append("0")
        times.append(f"{end / seconds:.4f}")
    return (
        f'<animate attributeName="opacity" calcMode="discrete" values="{";".join(values)}" '
        f'keyTimes="{";".join(times)}" dur="{seconds:g}s" repeatCount="indefinite"/>'
    )


def _robot(
    model: RobotModel,
    soles: Sequence[str],
    actor: Actor,
    times: FloatArray,
    seconds: float,
) -> list[str]:
    """Return the trunk and the legs, the far leg first."""
    record = actor.record
    posture = np.concatenate([record.posture, record.collapse])
    rows = np.round((times - record.time[0]) / (SAMPLE_EVERY * PERIOD)).astype(int)
    posture = posture[np.minimum(rows, len(posture) - 1)]
    order = [record.joint_names.index(name) for name in model.joint_names]
    posture = np.concatenate([posture[:, :7], posture[:, 7:][:, order]], axis=1)
    lines = []
    for points, is_far in _skeleton(model, soles, posture):
        values = ";".join(
            " ".join(f"{x:.0f},{y:.0f}" for x, y in frame) for frame in _on_screen(points).tolist()
        )
        lines.append(
            f'<polyline fill="none" stroke="{actor.colour}" stroke-width="9" '
            'stroke-linecap="round" stroke-linejoin="round"'
            f"{' class=' + chr(34) + 'far' + chr(34) if is_far else ''} "
            f'points="{values.partition(";")[0]}"><animate attributeName="points" '
            f'dur="{seconds:g}s" repeatCount="indefinite" values="{values}"/></polyline>'
        )
    return lines


def _on_screen(points: FloatArray) -> FloatArray:
    """Return x to the right and z up (T, P, 2), m, in pixels."""
    return np.stack(
        [PANEL[0] / 2 + PIXELS * points[..., 0], FLOOR - PIXELS * points[..., 1]], axis=-1
    )


def _skeleton(
    model: RobotModel, soles: Sequence[str], posture: FloatArray
) -> list[tuple[FloatArray, bool]]:
    """Return polylines (T, P, 2), x and z in the world, m, and whether they are far away."""
    poses = link_poses(model, posture[:, 7:])
    base = rotation_from_quaternion(posture[:, 3:7])

    def in_world(points: FloatArray) -> FloatArray:
        moved: FloatArray = np.einsum("tij,tpj->tpi", base, points) + posture[:, None, :3]
        return moved

    found = []
    for sole in soles:
        frame = model.frame(sole)
        chain = [frame.link]
        while chain[0] != 0:
            chain.insert(0, model.joints[chain[0] - 1].parent)
        ends = [frame.translation + frame.rotation @ np.array([along, 0.0, 0.0]) for along in FOOT]
        rotation, origin = poses.rotation[:, frame.link], poses.position[:, frame.link]
        # The first link of a leg lies beside the base, and would hide the trunk.
        chain = chain[2:] or chain
        foot = np.stack([origin + rotation @ end for end in ends], axis=1)
        points = in_world(np.concatenate([poses.position[:, chain], foot], axis=1))
        found.append((points[..., [0, 2]], float(points[0, -1, 1])))
    far = max(side for _, side in found)
    legs = [(points, side == far) for points, side in found]
    above = in_world(np.broadcast_to([0.0, 0.0, TRUNK], (len(posture), 1, 3)))[:, 0, [0, 2]]
    hips = np.mean([points[:, 0] for points, _ in found], axis=0)
    near = [(points, False) for points, is_far in legs if not is_far]
    return [
        *((points, True) for points, is_far in legs if is_far),
        (np.stack([above, hips], axis=1), False),
        *near,
    ]
