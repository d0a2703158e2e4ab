"""A robot, its balance controller and its identifier in one process and in simulated time."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.bags import BagWriter, create_folder
from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.learning.candidate import RobotUncertainty, candidate_model, robot_uncertainty
from symbid_ros.learning.model_update import ModelUpdate
from symbid_ros.messages.topics import Topic, TopicSelection, TopicSelector
from symbid_ros.model.load import load_model
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.recording import SimulatedTopic, sensor_topics, truth_topics
from symbid_ros.simulation.sensors import SCALAR_FIRST, Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.standing_controller import StandingController

PERIOD = 1e-3  # s, of simulator and controller
WIDE, SMOOTH = "wide", "smooth"  # scenarios
SAMPLE_EVERY, ADVANCE_EVERY, ESTIMATE_EVERY = 20, 100, 1000  # periods
COLLAPSE = 1.5  # s after a fall
FELL, ATTACHED, REMOVED, CHANGED = "fell", "attached", "removed", "changed"


@dataclass(frozen=True)
class LearningTask:
    """What the robot does, and what it carries.

    Attributes
    ----------
    model : Path
        The controller's MJCF model, from which the robot differs.
    seconds : float or None
        Duration; None for that of the moves.
    moves : int
        Number of moves of the centre of mass; the robot stands still after them.
    motion_seed, noise_seed : int
    scenario : str
        The moves: ``wide`` for robots that know themselves, or ``smooth``, in which they also carry
        a payload.
    payload : Payload or None
        Attached at ``attached`` and removed at ``removed``, s.
    attached, removed : float
    memory : float
        Time constant of forgetting, s.
    """

    model: Path
    seconds: float | None = None
    moves: int = 40
    motion_seed: int = 0
    noise_seed: int = 0
    scenario: str = WIDE
    payload: Payload | None = None
    attached: float = np.inf
    removed: float = np.inf
    memory: float = np.inf


@dataclass(frozen=True)
class Event:
    """Something that happened at a time, s: a model was accepted, a payload attached, a fall."""

    time: float
    kind: str
    text: str = ""


@dataclass(frozen=True)
class LearningRecord:
    """One run.

    Attributes
    ----------
    time : (N,) float64
        Of the samples, s.
    error : (N, 3) float64
        True centre of mass minus its reference, with moves from where it truly is in the initial
        pose, m.
    reach : (N,) float64
        Share of the size of the moves.
    applied, feed_forward : (N, A) float64
        Drive torques, and those of the model without feedback, Nm.
    posture : (N, 7 + J) float64
        True position and orientation (wxyz) of the base, and joint positions.
    joint_names : tuple of str
        Their order.
    collapse : (M, 7 + J) float64
        The same as ``posture`` after a fall, which is not sampled otherwise.
    estimates : tuple of RobotUncertainty
        Empty if the robot does not learn.
    events : tuple of Event
    """

    time: FloatArray
    error: FloatArray
    reach: FloatArray
    applied: FloatArray
    feed_forward: FloatArray
    posture: FloatArray
    joint_names: tuple[str, ...]
    collapse: FloatArray
    estimates: tuple[RobotUncertainty, ...]
    events: tuple[Event, ...]

    @property
    def fall(self) -> Event | None:
        """When and how the robot failed; None if it stands."""
        return next((event for event in self.events if event.kind == FELL), None)

    def between(self, start: float, stop: float) -> tuple[Event, ...]:
        """Return what happened from ``start`` until before ``stop``, s."""
        return tuple(event for event in self.events if start <= event.time < stop)

    def com_error(self, start: float, stop: float) -> float:
        """Return the root mean square distance from the reference, m; NaN without samples."""
        inside = (self.time >= start) & (self.time < stop)
        if not inside.any():
            return float("nan")
        return float(np.sqrt(np.mean(np.sum(self.error[inside] ** 2, axis=1))))

    def feed_forward_share(self, start: float, stop: float) -> float:
        """Return 1 minus the ratio of feedback to total torque (rms over time and drives)."""
        inside = (self.time >= start) & (self.time < stop)
        if not inside.any():
            return float("nan")
        applied = self.applied[inside]
        feedback = applied - self.feed_forward[inside]
        return max(0.0, 1.0 - float(np.sqrt(np.mean(feedback**2) / np.mean(applied**2))))


class _Publisher:
    """Fills the messages of topics, one instant at a time."""

    def __init__(self, topics: Sequence[SimulatedTopic]) -> None:
        self._topics = [
            (topic, records, topic.layout.columns(records))
            for topic in topics
            for records in [topic.layout.records(1)]
        ]
        self.names = [Topic(f"/{topic.name}", topic.layout.msgtype) for topic in topics]

    def messages(self, instant: Instant) -> Iterator[bytes]:
        """Yield the message of each topic."""
        for topic, records, columns in self._topics:
            topic.fill(columns, instant.stamp, instant)
            yield records[0].tobytes()


class _Identifier:
    """Identifies the robot from its messages, as the node ``identifier`` does."""

    def __init__(self, model: Path, topics: Sequence[Topic], memory: float) -> None:
        selector = TopicSelector("simulation", TopicSelection(), dict.fromkeys(topics, 1))
        initial_state = InitialState.of(load_model(model), IdentifyOptions())
        self.live = OnlineIdentification(
            initial_state, selector.select(), Pace(memory, in_step=True)
        )

    def solve(self) -> tuple[CandidateModel, RobotUncertainty] | None:
        """Return the model identified so far and its uncertainty; None before there is one."""
        found = self.live.solve()
        known = None if found is None else robot_uncertainty(found, self.live.intake.posture())
        return None if found is None or known is None else (candidate_model(found, known), known)


class LearningRun:
    """Simulates a robot, balances it and, if it learns, identifies it: all in simulated time.

    Equal tasks give equal records on one machine.

    Parameters
    ----------
    task : LearningTask
    learns : bool
        Whether identified models replace that of the file. Otherwise moves have their full size.
    bag : Path or None
        Folder of the bag with all topics of the robot, which must not exist.
    """

    def __init__(self, task: LearningTask, *, learns: bool, bag: Path | None = None) -> None:
        self._task, self._bag = task, bag
        options = SimulateOptions(moves=1, motion_seed=task.motion_seed, noise_seed=task.noise_seed)
        self._robot = Simulator(options, is_commanded=True)
        self._controller = StandingController(
            task.scenario,
            moves=task.moves,
            motion_seed=task.motion_seed,
            model_path=task.model,
            is_cautious=learns,
        )
        sensors = _Publisher(sensor_topics(self._robot))
        self._sensors, self._truth = sensors, _Publisher(truth_topics(self._robot))
        self._identifier = _Identifier(task.model, sensors.names, task.memory) if learns else None
        self._update = ModelUpdate(self._controller) if learns else None
        self._origin = self._robot.initial_com()
        self._samples: list[tuple[FloatArray, ...]] = []
        self._estimates: list[RobotUncertainty] = []
        self._events: list[Event] = []
        self._is_changed = False
        self._channels: list[int] = []
        self._collapsed: list[FloatArray] = []
        self._torques = np.zeros(len(self._robot.drive_names))

    def run(self) -> LearningRecord:
        """Simulate until the end or the fall."""
        for _ in self.seconds():
            pass
        return self.record()

    def seconds(self) -> Iterator[float]:
        """Simulate, and yield the time (s) after each second, until the end or the fall."""
        with ExitStack() as stack:
            bag = None
            if self._bag is not None:
                folder = stack.enter_context(create_folder(self._bag))
                bag = stack.enter_context(BagWriter(folder))
                for topic in (*self._sensors.names, *self._truth.names):
                    self._channels.append(bag.add_topic(topic.name, topic.msgtype))
            if self._identifier is not None:
                stack.callback(self._identifier.live.close)
            try:
                yield from self._simulate(bag)
            except RobotFailureError as failure:
                self._events.append(Event(failure.time, FELL, failure.cause))
                self._collapse()

    def record(self) -> LearningRecord:
        """Return the run up to now."""
        time, error, reach, applied, feed_forward, posture = map(
            np.array, zip(*self._samples, strict=True)
        )
        return LearningRecord(
            time=time,
            error=error,
            reach=reach,
            applied=applied,
            feed_forward=feed_forward,
            posture=posture,
            joint_names=self._robot.joint_names,
            collapse=np.array(self._collapsed).reshape(-1, posture.shape[1]),
            estimates=tuple(self._estimates),
            events=tuple(self._events),
        )

    @property
    def events(self) -> tuple[Event, ...]:
        """What has happened up to now."""
        return tuple(self._events)

    @property
    def reach(self) -> float:
        """Share of the size of the moves at present."""
        return self._controller.reach

    @property
    def duration(self) -> float:
        """Duration of the run if the robot does not fall, s."""
        return self._task.seconds or self._controller.duration

    def _simulate(self, bag: BagWriter | None) -> Iterator[float]:
        robot, controller = self._robot, self._controller
        instant = robot.step()
        for step in range(round(self.duration / PERIOD)):
            self._carry(step)
            self._torques = controller.torques(instant)
            if step % SAMPLE_EVERY == 0:
                self._sample(step * PERIOD, instant, self._torques)
            self._publish(bag, instant)
            if self._identifier is not None:
                if (step + 1) % ADVANCE_EVERY == 0:
                    self._identifier.live.advance()
                if (step + 1) % ESTIMATE_EVERY == 0:
                    self._learn(self._identifier)
            if (step + 1) % ESTIMATE_EVERY == 0:
                yield (step + 1) * PERIOD
            instant = robot.step(self._torques)

    def _collapse(self) -> None:
        """Continue after a fall with the last torques, until the robot is half as high."""
        height = self._samples[0][-1][2]
        for step in range(round(COLLAPSE / PERIOD)):
            position = self._robot.step_after_failure(self._torques)
            if position[2] < height / 2:
                return
            if step % SAMPLE_EVERY == 0:
                self._collapsed.append(position)

    def _carry(self, step: int) -> None:
        """Attach or remove the payload, from the next period on."""
        task, time = self._task, step * PERIOD
        if task.payload is None:
            return
        for when, kind, payload in (
            (task.attached, ATTACHED, task.payload),
            (task.removed, REMOVED, None),
        ):
            if time - PERIOD / 2 <= when < time + PERIOD / 2:
                self._robot.attach(payload)
                self._origin = self._robot.initial_com()
                text = f"{task.payload.mass:g} kg, {task.payload.link}"
                self._events.append(Event(time, kind, text))

    def _sample(self, time: float, instant: Instant, torques: FloatArray) -> None:
        controller = self._controller
        error = self._robot.com - self._origin - controller.displacement
        posture = np.concatenate(
            [instant.base_position, instant.base_orientation.take(SCALAR_FIRST)]
        )
        self._samples.append(
            (
                np.array(time),
                error,
                np.array(controller.reach),
                torques,
                controller.feed_forward(),
                np.concatenate([posture, instant.true_position]),
            )
        )

    def _publish(self, bag: BagWriter | None, instant: Instant) -> None:
        """Let the identifier and the bag have the messages of one instant."""
        if bag is None and self._identifier is None:
            return
        messages = list(self._sensors.messages(instant))
        if self._identifier is not None:
            for topic, message in zip(self._sensors.names, messages, strict=True):
                self._identifier.live.intake.feed(topic, message)
        if bag is not None:
            messages += self._truth.messages(instant)
            for channel, message in zip(self._channels, messages, strict=True):
                bag.write(channel, instant.stamp, message)

    def _learn(self, identifier: _Identifier) -> None:
        found = identifier.solve()
        if found is None or self._update is None:
            return
        candidate, uncertainty = found
        self._estimates.append(uncertainty)
        if candidate.change and not self._is_changed:
            self._events.append(Event(uncertainty.time, CHANGED, candidate.change))
        self._is_changed = bool(candidate.change)
        decision = self._update.judge(candidate, f"{uncertainty.time:.1f} s")
        if decision is not None:
            self._events.append(Event(uncertainty.time, decision.kind, decision.reason))
