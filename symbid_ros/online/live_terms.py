"""The joint terms that the data of a live identification ask for."""

from dataclasses import replace

from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.terms.choice import TermChoice, choose_terms
from symbid_ros.identification.terms.priors import candidate_prior, named_term_prior
from symbid_ros.model.parameters import ParameterSet

# Factor by which the number of blocks grows between two choices.
CHOOSE_AGAIN = 1.5


class LiveTerms:
    """Chooses joint terms again as data grow.

    Parameters
    ----------
    parameters : ParameterSet
        All columns of the data; terms are chosen if they are candidates.
    """

    def __init__(self, parameters: ParameterSet) -> None:
        self._parameters = parameters
        self._choice: TermChoice | None = None
        self._chosen_at = 0
        # The prior of the columns, of how many blocks it was found, and the one it comes from.
        self._prior: tuple[int, Prior, Prior] | None = None

    @property
    def slips(self) -> bool | None:
        """Whether rows of joints that may stick are left out; None before the first choice."""
        return None if self._choice is None else self._choice.slips

    def applied(self, problem: Problem, count: int, window: float) -> Problem:
        """Return a problem with the terms that ``count`` blocks ask for.

        The choice is made again when there are half as many blocks again as at the last one, then
        from the rows of the present window length, s, alone: a comparison of all takes as long as
        several estimates.
        """
        problem = self.with_prior(problem, count)
        if not self._parameters.candidates:
            return problem
        if self._choice is None or count >= CHOOSE_AGAIN * self._chosen_at:
            before, some = self._choice, problem
            if before is not None:
                present = [one for one in problem.observations if one.window == window]
                some = replace(problem, observations=tuple(present) or problem.observations)
            self._choice, self._chosen_at = choose_terms(some, before), max(count, 1)
        return self._choice.applied(problem)

    def chosen_anew(self, problem: Problem) -> Problem:
        """Return a problem with the terms that an offline run on the same data chooses."""
        problem = replace(problem, prior=self._sized_prior(problem))
        if not self._parameters.candidates:
            return problem
        self._choice = choose_terms(problem)
        return replace(self._choice.applied(problem), choice=self._choice)

    def with_prior(self, problem: Problem, count: int) -> Problem:
        """Return a problem whose prior has the sizes of terms that ``count`` blocks suggest."""
        known = self._prior
        if known is None or not count or known[0] != count or known[1] is not problem.prior:
            known = self._prior = count, problem.prior, self._sized_prior(problem)
        return replace(problem, prior=known[2])

    def usable_rows(self, observations: Observations) -> Observations:
        """Return the rows that the chosen terms allow; all if none of them slips yet."""
        if self._choice is None:
            return observations
        return next(iter(self._choice.rows((observations,))), observations)

    def clear(self) -> None:
        """Forget the choice."""
        self._choice = None

    def _sized_prior(self, problem: Problem) -> Prior:
        """Return the prior with deviations of joint terms that suit the robot's efforts."""
        parameters, prior = self._parameters, problem.prior
        if parameters.candidates:
            return candidate_prior(prior, parameters, problem.observations[0])
        if parameters.terms and problem.is_empirical:
            return named_term_prior(prior, parameters, problem.observations[0])
        return prior
