"""Whether a controller may take over an identified model of its robot."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import DataError, OptionError
from symbid_ros.model.inertia import is_consistent

# Share of the deviations of the last model to which those of mass or first moments must have
# fallen. Models whose differences are within their noise would otherwise follow each other forever.
FALLEN = 0.8
# Deviations of the whole robot's mass, as a share, and of its centre of mass, m, below which a
# more certain model would change nothing that a controller notices.
NEGLIGIBLE_MASS, NEGLIGIBLE_COM = 1e-3, 1e-3


@dataclass(frozen=True)
class CandidateModel:
    """An identified robot that a controller may use.

    Attributes
    ----------
    links : tuple of str
        Names of L links.
    phi, std : (L, 10) float64
        [m, m·c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] of each link about its frame, SI units, and
        standard deviations.
    alarms : tuple of str
        What speaks against the estimate.
    change : str
        How the robot differs from what it was, if the estimate has not followed; empty otherwise.
    mass_std, com_std : float or None
        Standard deviations of the mass of all links, kg, and of the robot's centre of mass (root
        sum square of its coordinates), m, from the covariance of all parameters. None if only the
        deviations of single parameters are known, which are larger: masses that the robot's motion
        does not tell apart are uncertain, but their sum is not.

    Raises
    ------
    DataError
        When an array has another shape.
    """

    links: tuple[str, ...]
    phi: FloatArray
    std: FloatArray
    alarms: tuple[str, ...] = ()
    mass_std: float | None = None
    com_std: float | None = None
    change: str = ""

    def __post_init__(self) -> None:
        expected = (len(self.links), 10)
        for name in ("phi", "std"):
            shape = np.shape(getattr(self, name))
            if shape != expected:
                raise DataError(
                    f"candidate model: {name} has shape {shape}, expected {expected}: ten "
                    "parameters of each link",
                    "E511",
                )

    @property
    def uncertainty(self) -> FloatArray:
        """Deviations (2,) on which balance and gravity torques depend.

        Those of the robot's mass, as a share of it, and of its centre of mass, m, at least as
        large as negligible ones. If they are unknown, root sum squares over the links of those of
        masses, kg, and of first moments, kg m.
        """
        if self.mass_std is None or self.com_std is None:
            masses, moments = self.std[:, 0], self.std[:, 1:4]
            return np.sqrt([np.sum(masses**2), np.sum(moments**2)])
        mass = float(np.sum(self.phi[:, 0]))
        share = self.mass_std / mass if mass else np.inf
        return np.maximum([share, self.com_std], [NEGLIGIBLE_MASS, NEGLIGIBLE_COM])


class ModelGate:
    """Accepts models that are possible, have no alarm, change torques little and are more certain.

    Parameters
    ----------
    largest_change : float
        Largest change of a torque that a model may cause, as a share of the drive's limit.

    Raises
    ------
    OptionError
        When ``largest_change`` is not positive.
    """

    def __init__(self, largest_change: float = 0.25) -> None:
        try:
            is_positive = largest_change > 0
        except TypeError:  # such as a text
            is_positive = False
        if not is_positive:
            raise OptionError(
                f"`largest_change` must be a number above 0, got {largest_change!r}", "E501"
            )
        self._largest_change = largest_change
        self._known = np.full(2, np.inf)

    def forget(self) -> None:
        """Forget the last accepted model: the next candidate need not be more certain."""
        self._known = np.full(2, np.inf)

    def is_news(self, candidate: CandidateModel) -> bool:
        """Return whether a candidate is clearly more certain than the last accepted model.

        A change of the robot makes the gate forget that model. A candidate without deviations
        counts as news, so that :meth:`refusal` says what is missing.
        """
        if candidate.change:
            self.forget()
        now = candidate.uncertainty
        if not np.isfinite(now).all():
            return True
        return bool(np.all(now <= self._known) and np.any(now <= FALLEN * self._known))

    def refusal(
        self, candidate: CandidateModel, torque_change: FloatArray, torque_limit: FloatArray
    ) -> str:
        """Return why a model must not be used, or an empty string, which accepts it.

        Parameters
        ----------
        candidate : CandidateModel
        torque_change : (A,) float64
            By how much the torques would differ from those of the model in use, in the present
            state, Nm.
        torque_limit : (A,) float64
            Largest torques of the drives, Nm.

        Raises
        ------
        DataError
            When these arrays differ in length.
        """
        change, limit = np.asarray(torque_change), np.asarray(torque_limit)
        if change.shape != limit.shape or change.ndim != 1:
            raise DataError(
                f"torque_change has shape {change.shape} and torque_limit {limit.shape}; give one "
                "number for each drive in both",
                "E511",
            )
        reason = self.fault(candidate) or self._jump(change, limit)
        if not reason:
            self._known = candidate.uncertainty
        return reason

    @staticmethod
    def fault(candidate: CandidateModel) -> str:
        """Return why no controller should use a model, or an empty string."""
        against = (candidate.change, *candidate.alarms)
        if any(against):
            return f"alarm: {next(filter(None, against))}"
        if not (np.isfinite(candidate.phi).all() and np.isfinite(candidate.std).all()):
            return "parameters or standard deviations are missing"
        impossible = [
            link
            for link, phi in zip(candidate.links, candidate.phi, strict=True)
            if not is_consistent(phi)
        ]
        return f"physically impossible: {', '.join(impossible)}" if impossible else ""

    def _jump(self, change: FloatArray, limit: FloatArray) -> str:
        if not len(change):
            return ""
        # A drive without torque may not change at all.
        share = np.where(change == 0.0, 0.0, np.inf)
        np.divide(np.abs(change), limit, out=share, where=limit != 0.0)
        worst = int(np.argmax(share))
        # Written so that NaN is refused too.
        if not share[worst] <= self._largest_change:
            return (
                f"drive {worst + 1} would change by {change[worst]:.2g} Nm, more than "
                f"{100 * self._largest_change:.0f} % of its {limit[worst]:.3g} Nm"
            )
        return ""
