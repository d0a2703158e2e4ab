"""Online identification: takes messages as they arrive and returns an estimate at any time.

Complete blocks are processed exactly as in an offline run, so both hold the same data at the end
of each block. Newer messages are added at once for an up-to-date estimate, and are processed again
with their block.
"""

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.estimate import RowSettings
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.conventions.assumed_contacts import assumed_contacts
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.problem import Problem, Truncation
from symbid_ros.identification.rows.accumulator import (
    Accumulator,
    BlockAccumulator,
    BlockRows,
    TimeSpan,
    build_block_rows,
)
from symbid_ros.identification.rows.change_monitor import Change, ChangeMonitor
from symbid_ros.identification.rows.window_comparison import WindowSelector
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.messages.topics import SelectedTopics
from symbid_ros.online.block_scheduler import BlockScheduler
from symbid_ros.online.block_worker import BlockWorker
from symbid_ros.online.changed_priors import ChangedPriors
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.online.initial_state import InitialState
from symbid_ros.online.live_calibration import FEW, MOST_KEPT, LiveCalibration
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.online.live_terms import LiveTerms
from symbid_ros.online.message_intake import MessageIntake
from symbid_ros.online.weight_check import WeightCheck, setup_fault
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.signals.log import Log
from symbid_ros.signals.weak_form import check_windows, equation_rows, suitable_windows

logger = logging.getLogger(__name__)

RECENT_FAULTS = 10


@dataclass(frozen=True)
class Pace:
    """Forgetting, waiting and processor share of an online identification.

    Attributes
    ----------
    memory : float
        Time constant of forgetting, s: after it a row has 1/e of its weight.
    lag : float
        How long to wait for a topic that lags behind the joint states, s. After that, its block
        is processed without the missing messages.
    share : float
        Share of a core for building the rows of complete blocks.
    in_step : bool
        Whether to wait for these rows. Estimates then depend on the messages alone, not on the
        speed of the computer.
    """

    memory: float = np.inf
    lag: float = 0.5
    share: float = 0.15
    in_step: bool = False


class OnlineIdentification:
    """Identifies a robot from messages as they arrive.

    Parameters
    ----------
    initial_state : InitialState
        Options, model, prior and data of an earlier run.
    selected : SelectedTopics
        The robot's sensors.
    pace : Pace
        Forgetting, waiting and processor share.

    Attributes
    ----------
    intake : MessageIntake
        Takes the messages.
    faults : deque of str
        Errors of the latest lost blocks.
    lost_blocks : int
        Number of blocks that could not be used.
    setup_fault : str
        Why these topics and options cannot give an estimate; empty if they can.
    standing_on : tuple of str
        With a `setup_fault`, where a robot with legs seems to stand, as `contact` names it. Empty
        until a block of messages shows it; nothing is identified afterwards.
    """

    def __init__(self, initial_state: InitialState, selected: SelectedTopics, pace: Pace) -> None:
        self._initial_state, self._pace = initial_state, pace
        self._options, self._parameters = initial_state.options, initial_state.problem.parameters
        self._windows = tuple(one.window for one in initial_state.observations)
        topics = tuple(topic.name for topic in selected.all)
        self._inputs = (*initial_state.problem.inputs, *topics)
        self._problem = replace(initial_state.problem, inputs=self._inputs)
        self._calibration: LiveCalibration | None = None
        self._changed = ChangedPriors(self._parameters, self._problem.remarks)
        self._terms = LiveTerms(self._parameters)
        self._scheduler = BlockScheduler(selected, self._parameters.model, pace.lag, "live topics")
        self.faults: deque[str] = deque(maxlen=RECENT_FAULTS)
        self.lost_blocks = 0
        model = self._parameters.model
        self.intake = MessageIntake(selected, model, self.streams, self._restart_clock)
        self.setup_fault = setup_fault(selected, model)
        self.standing_on: tuple[str, ...] = ()
        self._weight = WeightCheck(self._parameters, self.streams, self.setup_fault)
        self._posterior: Posterior | None = None
        # With the number of blocks from which it was found.
        self._is_coupled: tuple[int, bool] | None = None
        self._until = 0
        # What the last estimate was made from: messages up to a stamp, ns, and processed blocks.
        self._solved: tuple[int | None, BlockAccumulator | None] = None, None
        self._selector, self._monitor = WindowSelector(), ChangeMonitor(self._parameters)
        # Windows that suit the topics' rate; empty until the rate is known.
        self._usable_windows: tuple[float, ...] = ()
        known = BlockAccumulator(initial_state.observations, pace.memory)
        self._accumulator = Accumulator(known, len(self._windows) // 2)
        self._worker = BlockWorker(
            equation_rows(self._parameters),
            self._windows,
            pace.share,
            known,
            MOST_KEPT if self._options.sensor_error_kinds else 0,
        )

    @property
    def streams(self) -> LiveStreams:
        """Buffered messages."""
        return self._scheduler.streams

    @property
    def has_news(self) -> bool:
        """Whether messages or processed blocks arrived after the last estimate."""
        until, blocks = self._solved
        complete = self.streams.complete_until
        return complete is not None and (
            complete != until or self._accumulator.blocks is not blocks
        )

    @property
    def evidence(self) -> float:
        """Evidence for a change above its usual level; NaN before the first estimate."""
        return self._monitor.evidence

    @property
    def can_tell_change(self) -> bool:
        """Whether the usual level of evidence is known well enough to detect a change."""
        return self._monitor.is_ready

    @property
    def can_tell_fit(self) -> bool:
        """Whether there are enough data to judge if the model with its joint terms explains them.

        Before, friction that is not chosen yet looks like wrong inertias.
        """
        return self.can_tell_change or not self._parameters.candidates

    def advance(self) -> None:
        """Queue complete blocks and add the rows of processed ones."""
        if self.standing_on:
            return
        for span in self._scheduler.complete_blocks():
            if self.setup_fault:
                self.standing_on = self._assumed_contacts(span)
                if self.standing_on:
                    return  # the messages stay in the buffers
            self._submit(span)
        worker = self._worker
        self._add_processed(worker.finish() if self._pace.in_step else worker.take_finished())

    def _assumed_contacts(self, span: TimeSpan) -> tuple[str, ...]:
        """Return where the robot seems to stand in a block whose messages are still buffered."""
        if span.fault or self._options.information is not None:
            return ()  # an earlier run had its own contacts
        streams = self.streams.between(span.start, span.stop)
        return assumed_contacts(self._parameters.model, Log.from_streams(streams))

    def hurry(self, timeout: float) -> bool:
        """Process queued blocks for at most ``timeout`` s; return whether all are processed.

        Only then an exact estimate need not wait for them.
        """
        return self._worker.hurry(timeout)

    def solve(self, *, exactly: bool = False) -> OnlineEstimate | None:
        """Return the estimate from the messages so far; None if there are too few.

        Parameters
        ----------
        exactly : bool
            Do what an offline run on the same messages does: wait for queued blocks, process the
            open block like the last one of a log, and compare all windows.

        Raises
        ------
        DataError
            When the measured forces do not match the robot's weight, or a wrist sensor reads the
            opposite wrench.
        """
        self.advance()
        self._solved = self.streams.complete_until, self._accumulator.blocks
        known = self._accumulator.blocks.stop or 0  # end of the processed blocks
        new = [
            self._partial_rows(span)
            for span in self._scheduler.partial_blocks()
            if span.segments and span.stop > known
        ]
        for piece in new:
            self._accumulator.add(piece)
            self._until = piece.stop - 1
        return self._solve_exactly() if exactly else self._solve_approximately(new)

    def _solve_exactly(self) -> OnlineEstimate | None:
        self._add_processed(self._worker.finish(longest=FEW))
        open_block = self._scheduler.open_block()
        if open_block is not None and open_block.segments:
            self._prepare_rows(open_block)
        solved = self._exact_solution(open_block)
        while solved is not None and self._relinearize(solved.posterior):
            self._add_processed(self._worker.finish())
            solved = self._exact_solution(open_block)
        self._solved = self.streams.complete_until, self._accumulator.blocks
        return (
            None
            if solved is None
            else self._estimate(solved, self._monitor.change, with_verdict=True)
        )

    def _exact_solution(self, open_block: TimeSpan | None) -> SolvedProblem | None:
        """Solve all blocks and the open one; None if there are too few data."""
        blocks = self._accumulator.blocks
        if open_block is not None and open_block.segments:
            blocks = self._worker.with_block(blocks, open_block)
            self._until = open_block.stop - 1
        problem = self._problem_with(blocks)
        if not problem.observations:
            return None
        self._check_weight(problem.observations[0])
        return SolvedProblem.of(self._terms.chosen_anew(problem))

    def _relinearize(self, found: Posterior) -> bool:
        """Begin to linearize the rows about an estimate if it moved; return whether it did."""
        calibration, worker = self._calibration, self._worker
        if calibration is None or worker.is_relinearizing:
            return False
        build = calibration.better_rows(found, worker.build, self._accumulator.blocks.count)
        if build is None:
            return False
        worker.relinearize(build)
        return True

    def _solve_approximately(self, new: Sequence[BlockRows]) -> OnlineEstimate | None:
        problem = self._problem_with(self._accumulator.blocks)
        now = self._accumulator.current
        if now.rows.samples == 0:
            return None
        self._check_weight(now)
        # Before the first complete block the newest data are the only observations.
        blocks = self._choose_terms(replace(problem, observations=problem.observations or (now,)))
        if problem.observations:
            self._choose_window(blocks)
            now = self._accumulator.current
        problem, now = blocks, self._terms.usable_rows(now).restricted(blocks.prior.names)
        # Whether covariances may be weights is tested with each complete block.
        count, tested = self._accumulator.blocks.count, self._is_coupled
        is_coupled = tested[1] if tested is not None and tested[0] == count else None
        start = self._start(problem.prior)
        solved = SolvedProblem.approximate(problem, now, start, is_coupled=is_coupled)
        self._is_coupled = count, solved.chosen.is_coupled
        self._posterior = solved.posterior
        self._relinearize(solved.posterior)
        # What is known of the noise comes with the first block. Until then deviations are too small
        # for a comparison, except with the wide prior of the start.
        change = self._monitor.change
        if new and (not self._changed.has_restarted or self._accumulator.blocks.count):
            rows = [block.slipping() for block in new] if self._terms.slips else new
            self._monitor.update(rows, solved.posterior)
            change = self._monitor.change  # which this estimate, also of older data, contradicts
            self._follow_change()
        return self._estimate(solved, change, with_verdict=False)

    def _start(self, prior: Prior) -> FloatArray | None:
        """Return the last estimate, or else the mean, of a prior's parameters."""
        last = self._posterior
        if last is None:
            return None
        known = dict(zip(last.prior.names, last.mean.tolist(), strict=True))
        means = zip(prior.names, prior.mean.tolist(), strict=True)
        return np.array([known.get(name, mean) for name, mean in means])

    def _choose_terms(self, problem: Problem) -> Problem:
        """Return the problem with the joint terms that the data ask for."""
        before = self._terms.slips
        blocks, window = self._accumulator.blocks, self._windows[self._accumulator.window]
        chosen = self._terms.applied(problem, blocks.count, window)
        if before not in (None, self._terms.slips):
            self._monitor.restart()
        return chosen

    def _follow_change(self) -> None:
        """Start anew from what was known before a change, if old data are forgotten.

        Rows from before and after it would contradict each other until the former are forgotten.
        """
        if np.isinf(self._pace.memory):
            return
        if self._calibration is not None:
            self._problem = self._changed.relaxed(self._problem, self._monitor.change)
            return
        if (settled := self._monitor.settled) is None:
            return
        problem = self._problem_with(self._accumulator.blocks)
        if problem.observations:
            problem = self._terms.with_prior(problem, self._accumulator.blocks.count)
        self._problem = self._changed.restarted(self._problem, settled, problem.prior)
        until = self._until
        self._discard_data(self._accumulator.window)
        self._until = until  # later messages are stamped by the same clock
        self._monitor.follow()

    def _problem_with(self, blocks: BlockAccumulator) -> Problem:
        observations = tuple(
            one
            for one in blocks.observations
            if one.rows.samples > 0 and one.window in (self._usable_windows or self._windows)
        )
        build = self._worker.build
        calibrated_rows = build if isinstance(build, CalibratingRows) else None
        return replace(self._problem, observations=observations, calibrated_rows=calibrated_rows)

    def _prepare_rows(self, span: TimeSpan) -> None:
        """Use the windows that suit the rate; start with the middle one until they are compared.

        Rows with sensor errors have other columns, and windows of their own.

        Raises
        ------
        DataError
            When the topics are too slow for every window.
        """
        rate = span.segments[0].rate
        check_windows(self._windows, rate, "live topics")
        kinds = self._options.sensor_error_kinds
        if kinds and self._calibration is None:
            tares = self._initial_state.tares
            self._calibration = LiveCalibration(self._problem, span, kinds, tares)
            self._problem, self._windows = (
                self._calibration.extended.problem,
                self._calibration.windows,
            )
            nothing = BlockAccumulator(self._calibration.no_observations, self._pace.memory)
            self._monitor = ChangeMonitor(self._parameters, self._calibration.hypotheses)
            self._worker.restart(nothing, self._calibration.first_rows, self._windows)
            self._accumulator.restart(nothing, len(self._windows) - 1)
        self._usable_windows = suitable_windows(self._windows, rate)
        if self._windows[self._accumulator.window] not in self._usable_windows:
            middle = self._usable_windows[len(self._usable_windows) // 2]
            self._accumulator.restart(self._accumulator.blocks, self._windows.index(middle))

    def _choose_window(self, problem: Problem) -> None:
        best = self._selector.update(problem, self._accumulator.blocks.count)
        if best is None:
            return
        window = self._windows.index(best)
        if window != self._accumulator.window:
            self._accumulator.restart(self._accumulator.blocks, window)
            self._monitor.restart()

    def _estimate(
        self, solved: SolvedProblem, change: Change | None, *, with_verdict: bool
    ) -> OnlineEstimate:
        found = self._identify(solved, with_verdict=with_verdict)
        # Truncated methods have no covariance, and may be far from what the data and prior say.
        value = solved.posterior.mean if found.factor is None else found.unknowns
        window = solved.chosen.window
        rows = RowSettings("weak", window=window)
        found = replace(found, estimate=replace(found.estimate, rows=rows))
        return OnlineEstimate(
            self._changed.compared_with_the_first(found),
            solved.problem.parameters,
            self._until,
            window,
            solved.alarms(value),
            any(one.is_gross for one in solved.unexplained[:1]),
            change,
            None if change is not None else self._monitor.followed,
        )

    def reset(self) -> None:
        """Discard everything except the prior and the tares."""
        initial = self._initial_state
        self._posterior = self._calibration = None
        for buffer in self.streams.buffers.values():
            buffer.clear_faults()
        self._terms.clear()
        self._changed.clear()
        self._problem = replace(initial.problem, inputs=self._inputs)
        self._windows = tuple(one.window for one in initial.observations)
        self._selector, self._monitor = WindowSelector(), ChangeMonitor(self._parameters)
        self._discard_data(len(self._windows) // 2)

    def _discard_data(self, window: int) -> None:
        """Discard all rows; later ones are of the window length of this index."""
        self._worker.finish()
        self._scheduler.restart()
        self._is_coupled = None
        nothing = BlockAccumulator(self._initial_state.no_observations, self._pace.memory)
        self._worker.restart(nothing, equation_rows(self._parameters), self._windows)
        self._accumulator.restart(nothing, window)
        self._until = 0

    def set_tares(self, tares: Mapping[str, Tare]) -> str:
        """Use what unloaded wrench sensors read, by frame, as priors of their offsets.

        Data from before are discarded if they contradict a tare, because the offset was another
        one. Returns what was done, as text.
        """
        self._initial_state = replace(
            self._initial_state, tares={**self._initial_state.tares, **tares}
        )
        self._restart_clock()  # the messages of the tare are missing
        calibration, found = self._calibration, self._posterior
        if calibration is None or found is None:
            return "the offsets are used from now on"
        if calibration.contradicts(found, tares):
            self.reset()
            return "the offsets have changed, so that all data from before are discarded"
        self._problem = calibration.with_tares(self._problem, tares)
        return "the data so far agree"

    def set_memory(self, time_constant: float) -> None:
        """Change the time constant of forgetting, s; older data keep their present weight."""
        self._add_processed(self._worker.finish())
        self._pace = replace(self._pace, memory=time_constant)
        blocks = replace(self._accumulator.blocks, time_constant=time_constant)
        self._worker.restart(blocks)
        self._accumulator.update_blocks(blocks)

    def close(self) -> None:
        """Discard queued blocks."""
        self._worker.close()

    def _restart_clock(self) -> None:
        """Process the open block; later messages may have any stamps."""
        self._submit(self._scheduler.restart())
        self._worker.finish(longest=FEW)
        self._accumulator.restart(self._worker.restart_clock(), self._accumulator.window)
        self._until = 0

    def _submit(self, span: TimeSpan | None) -> None:
        if span is None:
            return
        if not span.fault and span.segments:
            # A log may end with its first estimate, before a piece of the open block was read.
            try:
                self._prepare_rows(span)
            except SymbidError as error:
                span = replace(span, fault=str(error))
        if span.fault:
            self.lost_blocks += 1
            self.faults.append(span.fault)
            logger.warning(
                "%s; the block that starts at %.0f s is not used", span.fault, span.start * 1e-9
            )
            return
        self._worker.submit(span)

    def _add_processed(self, blocks: BlockAccumulator | None) -> None:
        if blocks is not None:
            self._accumulator.update_blocks(blocks)
            self._until = max(self._until, (blocks.stop or 1) - 1)

    def _partial_rows(self, span: TimeSpan) -> BlockRows:
        self._prepare_rows(span)
        # The noise level is estimated later, with the complete block: it doubles the run time.
        windows = [self._windows[self._accumulator.window]]
        return build_block_rows(span, self._worker.build, windows, ())

    def _check_weight(self, shortest: Observations) -> None:
        if not self._options.unchecked:
            self._weight.require(shortest, self._problem.prior)

    def _identify(self, solved: SolvedProblem, *, with_verdict: bool) -> Identification:
        method = self._options.method
        if method == "map_lmi":
            return solved.map_lmi(with_verdict=with_verdict)
        if method == "map":
            return solved.map(with_verdict=with_verdict)
        return solved.truncated(method, Truncation(self._options.rank))
