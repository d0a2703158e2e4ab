"""The online job: messages in as they arrive, at any time an estimate out.

Whole blocks of the clock are worked on exactly as an offline run works on them, so that the two
know the same at every block's end. What has come since then is taken in at once, for estimates
that are up to date, and worked on again with its block.
"""

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.estimation.change import relaxed_prior
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.identification.accumulator import (
    Accumulator,
    BlockAccumulator,
    BlockRows,
    TimeSpan,
    build_block_rows,
)
from symbid_ros.identification.change_monitor import Change, ChangeMonitor
from symbid_ros.identification.problem import Problem, Truncation, check_weight
from symbid_ros.identification.solver import Identification, Solver
from symbid_ros.identification.window_comparison import WindowSelector
from symbid_ros.messages.topics import SelectedTopics, Topic
from symbid_ros.online.block_scheduler import BlockScheduler
from symbid_ros.online.block_worker import BlockWorker
from symbid_ros.online.initial_state import InitialState
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.signals.weak_form import check_windows, equation_rows, suited_windows

logger = logging.getLogger(__name__)

RECENT_FAULTS = 10


@dataclass(frozen=True)
class Pace:
    """How the past is forgotten and the present waited for.

    Attributes
    ----------
    memory : float
        Time in which a row loses all but 1/e of its weight, s.
    lag : float
        How long a topic may lag behind the joint states before a block is worked on without what
        is missing, s.
    share : float
        Of a core that the rows of whole blocks may take.
    """

    memory: float = np.inf
    lag: float = 0.5
    share: float = 0.15


@dataclass(frozen=True)
class OnlineEstimate:
    """An estimate and up to when it knows the robot.

    Attributes
    ----------
    found : Identification
        The estimate, with the observations behind it; its verdict only if solved exactly.
    until : int
        Stamp of the newest data in it, ns.
    window : float
        Length of the rows' windows, s.
    alarms : tuple of str
        What is wrong, one line each.
    change : Change or None
        What the robot has changed in, if it has.
    """

    found: Identification
    until: int
    window: float
    alarms: tuple[str, ...]
    change: Change | None


class OnlineIdentification:
    """What is known of a robot, by the messages that have come.

    Parameters
    ----------
    beginning : InitialState
        The job, and what is known already.
    selected : SelectedTopics
        The robot's sensors.
    pace : Pace
        Of forgetting and waiting.

    Attributes
    ----------
    faults : deque of str
        What has been wrong with the latest faulty blocks.
    lost_blocks : int
        How many brought nothing for it.
    clock_jumps : int
        How often a topic's clock has jumped back.
    checks : dict of Topic to MessageCheck
        What they dropped, and why.
    """

    def __init__(self, beginning: InitialState, selected: SelectedTopics, pace: Pace) -> None:
        self._beginning, self._pace = beginning, pace
        self._options, self._parameters = beginning.options, beginning.problem.parameters
        self._windows = tuple(one.window for one in beginning.observations)
        self._build = equation_rows(self._parameters)
        topics = tuple(topic.name for topic in selected.all)
        self._problem = replace(
            beginning.problem,
            inputs=(*beginning.problem.inputs, *topics),
            has_wrenches=bool(selected.wrenches),
        )
        self._timeline = BlockScheduler(selected, self._parameters.model, pace.lag, "live topics")
        self.faults: deque[str] = deque(maxlen=RECENT_FAULTS)
        self.lost_blocks = self.clock_jumps = 0
        model = self._parameters.model
        self.checks = {
            topic: MessageCheck(topic, model, selected.frame_prefix) for topic in selected.all
        }
        self._posterior: Posterior | None = None
        self._released: set[str] = set()
        self._until = 0
        self._selector, self._monitor = WindowSelector(), ChangeMonitor(self._parameters)
        # Those that suit the topics' rate, once it is known.
        self._suited: tuple[float, ...] = ()
        known = BlockAccumulator(beginning.observations, pace.memory)
        self._accumulator = Accumulator(known, len(self._windows) // 2)
        self._work = BlockWorker(self._build, self._windows, pace.share, known)

    @property
    def streams(self) -> LiveStreams:
        """What has come."""
        return self._timeline.streams

    @property
    def has_news(self) -> bool:
        """Whether there is something that the last estimate did not know."""
        complete = self.streams.complete_until
        return complete is not None and complete > self._until

    @property
    def evidence(self) -> float:
        """For a change at the last look, over what has been usual; nan before there was one."""
        return self._monitor.evidence

    @property
    def can_tell_change(self) -> bool:
        """Whether what is usual is known well enough to tell a change from it."""
        return self._monitor.is_ready

    def feed(self, topic: Topic, payload: bytes) -> None:
        """Take a serialised message of one of the topics, whatever its bytes may be."""
        for stamp, usable in self.checks[topic].take(payload):
            self._feed(topic, stamp, usable)

    def _feed(self, topic: Topic, stamp: int, payload: bytes) -> None:
        streams = self._timeline.streams
        if streams.jumps_back(topic, stamp):
            logger.warning(
                "%s: its clock jumps back from %.3f s; alignment begins again, nothing learnt is "
                "lost",
                topic.name,
                (streams.buffers[topic].newest or 0) * 1e-9,
            )
            self.clock_jumps += 1
            self._put(self._timeline.restart())
            self._settle(self._work.finish())
            self._begin_time(self._accumulator.blocks.with_new_clock())
        streams.add(topic, stamp, payload)

    def advance(self) -> None:
        """Put blocks in line that are whole, take in those that have been worked on."""
        for stretch in self._timeline.whole():
            self._put(stretch)
        self._settle(self._work.done())

    def solve(self, *, exactly: bool = False) -> OnlineEstimate | None:
        """Return the estimate by what has come; None while that is too little.

        Parameters
        ----------
        exactly : bool
            Do what an offline run up to now would do: wait for blocks that are in line, work on
            the open one as on a log's last, and compare all windows.

        Raises
        ------
        DataError
            When the measured forces do not carry the robot.
        """
        self.advance()
        known = self._accumulator.blocks.stop or 0  # by blocks that have been worked on
        new = [
            self._piece(stretch)
            for stretch in self._timeline.pieces()
            if stretch.segments and stretch.stop > known
        ]
        for piece in new:
            self._accumulator.add(piece)
            self._until = piece.stop - 1
        return self._solve_exactly() if exactly else self._solve_roughly(new)

    def _solve_exactly(self) -> OnlineEstimate | None:
        self._settle(self._work.finish())
        whole, rest = self._accumulator.blocks, self._timeline.rest()
        if rest is not None and rest.segments:
            self._suit(rest)
            whole = whole.with_block(build_block_rows(rest, self._build, self._windows))
            self._until = rest.stop - 1
        problem = self._problem_of(whole)
        if not problem.observations:
            return None
        self._check_weight(problem.observations[0])
        return self._outcome(Solver.of(problem), with_verdict=True)

    def _solve_roughly(self, new: Sequence[BlockRows]) -> OnlineEstimate | None:
        problem = self._problem_of(self._accumulator.blocks)
        if problem.observations:
            self._choose_window(problem)
        now = self._accumulator.current
        if now.rows.samples == 0:
            return None
        self._check_weight(now)
        near = self._posterior
        start = None if near is None else near.mean
        # Before the first whole block there is nothing to compare what has come with.
        problem = replace(problem, observations=problem.observations or (now,))
        solver = Solver.approximate(problem, now, start)
        self._posterior = solver.posterior
        if new:
            self._monitor.update(new, solver.posterior)
            self._release()
        return self._outcome(solver, with_verdict=False)

    def _release(self) -> None:
        """Relax the prior of every link that may have changed, if old data are forgotten too."""
        change = self._monitor.change
        if change is None or np.isinf(self._pace.memory):
            return
        for suspect in change.suspects:
            if suspect.link not in self._released:
                self._released.add(suspect.link)
                prior = relaxed_prior(self._problem.prior, self._parameters, suspect.link)
                self._problem = replace(self._problem, prior=prior)

    def _problem_of(self, whole: BlockAccumulator) -> Problem:
        told = tuple(
            one
            for one in whole.observations
            if one.rows.samples > 0 and one.window in (self._suited or self._windows)
        )
        return replace(self._problem, observations=told)

    def _suit(self, stretch: TimeSpan) -> None:
        """Use the windows that suit a stretch's rate, the middle one until they are compared.

        Raises
        ------
        DataError
            When the topics are too slow for all of them.
        """
        rate = stretch.segments[0].rate
        check_windows(self._windows, rate, "live topics")
        self._suited = suited_windows(self._windows, rate)
        if self._windows[self._accumulator.window] not in self._suited:
            middle = self._suited[len(self._suited) // 2]
            self._accumulator.restart(self._accumulator.blocks, self._windows.index(middle))

    def _choose_window(self, problem: Problem) -> None:
        best = self._selector.update(problem, self._accumulator.blocks.count)
        if best is None:
            return
        window = self._windows.index(best)
        if window != self._accumulator.window:
            self._accumulator.restart(self._accumulator.blocks, window)
            self._monitor.restart()

    def _outcome(self, solver: Solver, *, with_verdict: bool) -> OnlineEstimate:
        found = self._identified(solver, with_verdict=with_verdict)
        window = solver.chosen.window
        return OnlineEstimate(found, self._until, window, solver.alarms, self._monitor.change)

    def reset(self) -> None:
        """Forget all but the prior."""
        self._settle(self._work.finish())
        self._timeline.restart()
        self._posterior = None
        self._released.clear()
        self._problem = replace(self._problem, prior=self._beginning.problem.prior)
        self._selector, self._monitor = WindowSelector(), ChangeMonitor(self._parameters)
        self._begin_time(BlockAccumulator(self._beginning.nothing, self._pace.memory))

    def set_memory(self, span: float) -> None:
        """Forget from now on with another memory, s; what is known keeps its present weight."""
        self._settle(self._work.finish())
        self._pace = replace(self._pace, memory=span)
        whole = replace(self._accumulator.blocks, time_constant=span)
        self._work.begin(whole)
        self._accumulator.update_blocks(whole)

    def close(self) -> None:
        """Give up blocks that are in line."""
        self._work.close()

    def _begin_time(self, whole: BlockAccumulator) -> None:
        self._work.begin(whole)
        self._accumulator.restart(whole, self._accumulator.window)
        self._until = 0

    def _put(self, stretch: TimeSpan | None) -> None:
        if stretch is None:
            return
        if stretch.fault:
            self.lost_blocks += 1
            self.faults.append(stretch.fault)
            logger.warning("%s; the block from %.0f s is lost", stretch.fault, stretch.start * 1e-9)
            return
        self._work.put(stretch)

    def _settle(self, whole: BlockAccumulator | None) -> None:
        if whole is not None:
            self._accumulator.update_blocks(whole)

    def _piece(self, stretch: TimeSpan) -> BlockRows:
        self._suit(stretch)
        # It is not searched for noise: that takes as long again, and its block will be.
        return build_block_rows(stretch, self._build, [self._windows[self._accumulator.window]], ())

    def _check_weight(self, shortest: Observations) -> None:
        if not self._options.unchecked:
            check_weight(shortest.rows, self._parameters, self._problem.prior)

    def _identified(self, solver: Solver, *, with_verdict: bool) -> Identification:
        method = self._options.method
        if method == "map_lmi":
            return solver.map_lmi(with_verdict=with_verdict)
        if method == "map":
            return solver.map(with_verdict=with_verdict)
        return solver.truncated(method, Truncation(self._options.rank))
