"""An outer loop around the tuner's plants: what it feeds back of the links that it moves."""

from __future__ import annotations

from collections.abc import Sequence

from seaopt.control.laws.spec import ControllerSpec
from seaopt.control.loops.law import Law
from seaopt.control.loops.loop import Loop
from seaopt.control.loops.measured.loop import DiscLoop
from seaopt.control.loops.measured.plant import MeasuredPlant
from seaopt.control.loops.moved_link import enclose_law, find_position, keep_share, respond_outer, show_position
from seaopt.control.loops.outer_loop import OuterLoop
from seaopt.control.loops.sampled_plant import DigitalPlant, sample
from seaopt.control.loops.transfer_function import Frequencies, Response
from seaopt.plants import CompletedParameters, Plant
from seaopt.records import record


@record(eq=False)
class MovedLinks:
    """An outer loop, and of each of a task's plants the one that it reads, the link's position last, with the share of
    a sample's position that is taken off the next; None where the link is held.
    """

    outer: OuterLoop
    plants: tuple[tuple[DigitalPlant, float] | None, ...]

    @classmethod
    def of(
        cls,
        outer: OuterLoop,
        models: Sequence[tuple[Plant, CompletedParameters] | None],
        signals: tuple[str, ...],
        per_effort: float,
        spec: ControllerSpec,
    ) -> MovedLinks:
        """Return an outer loop around plants with their parameters; None is a measured response, whose link is held."""

        def read(model: tuple[Plant, CompletedParameters] | None) -> tuple[DigitalPlant, float] | None:
            if model is None:
                return None
            plant, values = show_position(model[0], outer, signals), model[1]
            position = find_position(plant, outer)
            if position is None:
                return None
            read = (*signals, position)
            sampled = sample(plant, values, read, per_effort, spec.sample_time_s, spec.loop_delay_samples)
            return sampled, keep_share(position)

        return cls(outer=outer, plants=tuple(map(read, models)))

    def moves(self, row: int) -> bool:
        """Tell whether a plant's link moves."""
        return self.plants[row] is not None

    def respond(self, row: int, f: Frequencies) -> Response:
        """Return what is taken off the force law's reference, per command, of one plant; zeros of one that is held."""
        moved = self.plants[row]
        if moved is None:
            return 0j * f
        plant, kept = moved
        return respond_outer(self.outer, f, kept) * plant.responses(f)[-1]

    def close(self, row: int, law: Law) -> Loop | None:
        """Return the loop of a force law and the outer loop around one plant; None where the link is held."""
        moved = self.plants[row]
        if moved is None:
            return None
        plant, kept = moved
        return Loop(plant=plant, law=enclose_law(law, self.outer, kept=kept, of_force=True))


def close_plant(plant: DigitalPlant | MeasuredPlant, law: Law) -> Loop | DiscLoop:
    """Return the loop of a law around a plant, a model or a measured one."""
    return DiscLoop(plant=plant, law=law) if isinstance(plant, MeasuredPlant) else Loop(plant=plant, law=law)
