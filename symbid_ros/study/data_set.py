"""Simulated logs as a plan asks for them, and what is used of them."""

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from symbid_ros.study.sensing import Sensing

Seed = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1, le=1000)]


class Part(BaseModel):
    """An entry of the file; what it does not know is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Log(Part):
    """A simulated log.

    Attributes
    ----------
    scenario : {"smooth", "vibrating", "squat", "suspended"}
        What the robot does.
    moves : int
        Number of moves: the log's length.
    motion_seed, noise_seed, error_seed : int
        Of the motion, the sensors' noise, and their systematic errors.
    noise : float
        Factor on the deviations of noise.yaml; 0 leaves ideal sensors.
    friction : bool
        Whether the joints have friction and armature.
    errors : str
        Systematic errors, as `symbid simulate --errors` takes them.
    """

    scenario: Literal["smooth", "vibrating", "squat", "suspended"] = "smooth"
    moves: Count = 20
    motion_seed: Seed = 1
    noise_seed: Seed = 1
    noise: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    friction: bool = False
    errors: str = ""
    error_seed: Seed = 1

    @property
    def identity(self) -> str:
        """What tells its bag from other logs': equal logs are one."""
        parts = [f"{self.scenario} of {self.moves} moves {self.motion_seed}"]
        parts.append(f"noise {self.noise:g} x {self.noise_seed}" if self.noise else "no noise")
        parts += ["friction"] if self.friction else []
        parts += [f"{self.errors} {self.error_seed}"] if self.errors else []
        return ", ".join(parts)


class DataSet(Log):
    """A log to identify from.

    Attributes
    ----------
    sensors : {"all", "base_rows", "joint_rows", "no_plates"}
        Which rows of the equation of motion there are.
    cure : bool
        Let `map` and `map_lmi` find the sensors' errors, with a tare and a weighing.
    """

    sensors: Sensing = "all"
    cure: bool = False

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.noise == 0:
            raise ValueError("data without any noise decide everything; give noise above 0")
        if self.cure and self.sensors != "all":
            raise ValueError("cure needs all sensors")
        return self
