"""Lets a standing controller use identified models, and move only as far as it knows itself."""

from dataclasses import dataclass

from symbid_ros.errors import SymbidError
from symbid_ros.estimation.model_gate import CandidateModel, ModelGate
from symbid_ros.simulation.reach import safe_reach
from symbid_ros.simulation.standing_controller import StandingController

ACCEPTED, REFUSED, WITHDRAWN = "accepted", "refused", "withdrawn"


@dataclass(frozen=True)
class Decision:
    """What happened to a model.

    Attributes
    ----------
    kind : {"accepted", "refused", "withdrawn"}
    model : str
        Label of the model that the controller uses now; empty for that of its file.
    reason : str
        Why a model was refused or withdrawn.
    reach : float
        Share of the size of the moves from now on.
    """

    kind: str
    model: str
    reason: str = ""
    reach: float = 1.0

    @property
    def message(self) -> str:
        """The same as one line of a log."""
        if self.kind == ACCEPTED:
            return (
                f"model {self.model} replaces the present one; moves have "
                f"{100 * self.reach:.0f} % of their size"
            )
        if self.kind == WITHDRAWN:
            return f"the model is withdrawn: {self.reason}"
        return f"the identified model is not used: {self.reason}"


class ModelUpdate:
    """Judges each identified model, and hands it to the controller if it can be trusted.

    The size of the moves follows from the deviations of the model in use. Without one, and while
    the robot differs from what it was, moves are smallest. Other alarms concern the newest estimate
    and not the model in use.

    Parameters
    ----------
    controller : StandingController
    largest_change : float
        Largest change of a drive's torque that a model may cause, as a share of its limit.

    Attributes
    ----------
    counts : dict of str to int
        Number of decisions of each kind.
    used : str
        Label of the model in use; empty for that of the controller's file.
    refusal : str
        Why the newest model is not used; empty if it is, or is no better than the one in use.
    """

    def __init__(self, controller: StandingController, largest_change: float = 0.25) -> None:
        self._controller = controller
        self._gate = ModelGate(largest_change)
        self.counts = dict.fromkeys((ACCEPTED, REFUSED, WITHDRAWN), 0)
        self.used = self.refusal = self._before = ""
        controller.move_within(controller.least_reach)

    def judge(self, candidate: CandidateModel, label: str) -> Decision | None:
        """Use the newest model, refuse or withdraw one; return None if nothing changes.

        Parameters
        ----------
        candidate : CandidateModel
        label : str
            Name of the model in decisions, such as the time of its newest data.
        """
        controller = self._controller
        if candidate.change:
            controller.move_within(controller.least_reach)
        is_news = self._gate.is_news(candidate)
        if controller.is_changing:
            fault = candidate.change or next(iter(candidate.alarms), "")
            return self._withdraw(fault) if fault else None
        if not is_news:
            self.refusal = ""
            return None
        reason = self._adopt(candidate)
        is_repeated, self.refusal = reason == self.refusal, reason
        if not reason:
            self._before, self.used = self.used, label
            return self._decide(ACCEPTED)
        return None if is_repeated else self._decide(REFUSED, reason)

    def _withdraw(self, reason: str) -> Decision | None:
        if self.used == self._before:
            return None
        self._controller.fall_back()
        self._gate.forget()
        self.used = self._before
        return self._decide(WITHDRAWN, reason)

    def _decide(self, kind: str, reason: str = "") -> Decision:
        self.counts[kind] += 1
        return Decision(kind, self.used, reason, self._controller.wanted_reach)

    def _adopt(self, candidate: CandidateModel) -> str:
        """Let the controller use a model; return why not if it must not."""
        controller = self._controller
        fault = self._gate.fault(candidate)
        if fault:
            return fault
        try:
            proposal = controller.propose(dict(zip(candidate.links, candidate.phi, strict=True)))
        except SymbidError as error:
            return str(error)
        reason = self._gate.refusal(candidate, proposal.torque_change, controller.torque_limits)
        if not reason:
            controller.adopt(proposal)
            if candidate.mass_std is not None and candidate.com_std is not None:
                share = candidate.mass_std / float(candidate.phi[:, 0].sum())
                controller.move_within(safe_reach(share, candidate.com_std, controller.size))
        return reason
