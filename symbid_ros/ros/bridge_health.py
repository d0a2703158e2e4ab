"""What the bridge counts and how it says so."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from symbid_ros.ros.commands import TopicCounts
from symbid_ros.ros.health import ERROR, OK, WARN, Health
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.command import CommandCounts


@dataclass
class BridgeRecord:
    """How the simulation has gone.

    Attributes
    ----------
    starts, falls : int
        How often the motion has begun, and been broken off by the robot.
    steps, safe_steps : int
        Periods taken, of these with safe torques for want of a command.
    time : float
        Simulated, s.
    last_fall : str
        What happened then.
    payload : Payload or None
        What the robot carries.
    is_waiting, is_paused, is_safe : bool
        Whether time stands still for want of a controller or on demand, and whether the drives
        only brake.
    """

    starts: int = 0
    falls: int = 0
    steps: int = 0
    safe_steps: int = 0
    time: float = 0.0
    last_fall: str = ""
    payload: Payload | None = None
    is_waiting: bool = False
    is_paused: bool = False
    is_safe: bool = False

    def simulation(self, scenario: str, late_steps: int) -> Health:
        """Return the status of the simulation."""
        message = "running"
        if self.is_paused:
            message = "paused"
        elif self.is_waiting:
            message = "time stands still until a controller commands"
        if self.last_fall:
            message += f"; began anew as {self.last_fall}"
        values = {
            "scenario": scenario,
            "time": f"{self.time:.3f}",
            "steps": self.steps,
            "late_steps": late_steps,
            "starts": self.starts,
            "falls": self.falls,
            "payload": describe(self.payload),
        }
        return Health("simulation", WARN if self.last_fall else OK, message, values)

    def commands(
        self, source: str, controllers: Sequence[str], counts: TopicCounts | CommandCounts
    ) -> Health:
        """Return the status of the commands from outside.

        Parameters
        ----------
        source : str
            Topic or datagrams.
        controllers : sequence of str
            Who sends them.
        counts : TopicCounts or CommandCounts
            What came in.
        """
        level, message = OK, "commands are followed"
        if self.is_waiting:
            level, message = WARN, "waiting for a controller"
        elif self.is_safe:
            level, message = ERROR, "no command: the drives only brake"
        elif len(controllers) > 1:
            level, message = WARN, "several controllers command; stop all but one"
        values = {
            "source": source,
            "controllers": ", ".join(controllers) or "none",
            "safe_steps": self.safe_steps,
        }
        return Health("commands", level, message, values | figures(counts))


def figures(counts: TopicCounts | CommandCounts) -> dict[str, int]:
    """Return counts by name, rejections as ``rejected/<reason>``."""
    found: dict[str, int] = {}
    for name, value in asdict(counts).items():
        if isinstance(value, Mapping):
            found |= {f"{name}/{reason}": number for reason, number in value.items()}
        else:
            found[name] = value
    return found


def describe(payload: Payload | None) -> str:
    """Return a payload in words."""
    if payload is None:
        return "none"
    place = ", ".join(f"{coordinate:g}" for coordinate in payload.position)
    return f"{payload.mass:g} kg on {payload.link} at ({place}) m"
