"""Feedback as poor as a real robot's: late, and with noisy velocities."""

from collections import deque
from dataclasses import replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller import Controller
from symbid_ros.simulation.plant import State


class PoorFeedback:
    """Gives a controller states that are late and whose joint velocities are noisy.

    With a stiff controller this makes the legs vibrate as they do in the thesis's data
    (chapter 4). The noise belongs to the motion, not to the sensors.

    Parameters
    ----------
    controller : Controller
        Who gets the states.
    delay : int
        Periods.
    velocity_noise : float
        Standard deviation, rad/s: the difference of two noisy encoder readings a period apart,
        hence mostly of high frequency.
    joints : int
        Number of joints.
    random : numpy.random.Generator
        Source of the noise.
    """

    def __init__(
        self,
        controller: Controller,
        delay: int,
        velocity_noise: float,
        joints: int,
        random: np.random.Generator,
    ) -> None:
        self._controller = controller
        self._states: deque[State] = deque(maxlen=delay + 1)
        self._sigma = velocity_noise
        self._random = random
        self._last = np.zeros(joints)

    def torques(self, state: State) -> FloatArray:
        """Return the controller's torques for a state ``delay`` periods ago."""
        velocity = state.velocity.copy()
        reading = self._random.standard_normal(len(velocity) - 6)
        velocity[6:] += self._sigma / np.sqrt(2.0) * (reading - self._last)
        self._last = reading
        self._states.append(replace(state, velocity=velocity))
        return self._controller.torques(self._states[0])
