"""A cohort of ears whose stiffness and damping follow a planted law of their mass."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from simulate.ear import Ear
from simulate.stapes import Stapes
from stapeskit.arrays import Array

REFERENCE_KG = 3.2e-6


@dataclass(frozen=True, kw_only=True)
class Population:
    """How ears differ; every spread is a standard deviation of a natural logarithm."""

    ears: int = 12  # number of ears, and of persons with both of them
    pairs: int = 3
    size: float = 0.07  # of the whole stapes and of each of its axes
    stretch: float = 0.025
    scatter: float = 0.12  # of K and D about their laws, common to the degrees of freedom of a matrix
    entry_scatter: float = 0.05  # of each degree of freedom on its own
    likeness: float = 0.6  # correlation of the two ears of a person, in size and in scatter
    # of K and D over the mass, for y, alpha and gamma. A force goes with the length of the ligament; a
    # moment with two more powers of length
    exponents: tuple[float, float, float] = (1.0, 5.0 / 3.0, 5.0 / 3.0)
    ear: Ear = field(default_factory=Ear)  # what all have in common; its ligament has mass REFERENCE_KG
    seed: int = 4

    @property
    def intrinsic_sd(self) -> float:
        """Standard deviation of the logarithm of a diagonal entry about its law."""
        return float(np.hypot(self.scatter, self.entry_scatter))


@dataclass(frozen=True, kw_only=True)
class Member:
    """One ear of a cohort: its name and person, and the ear."""

    name: str
    subject: str
    age: float
    ear: Ear

    def about(self) -> dict[str, object]:
        """Return the keys of [study] that a cohort knows."""
        return {"side": self.ear.side, "subject": self.subject, "age": self.age}


def cohort(population: Population) -> Iterator[Member]:
    """Yield the ears of a cohort; K and D follow ``exponents`` of the true mass, plus the scatter.

    Right ears are mirror images: their couplings of alpha change sign.
    """
    rng = np.random.default_rng(population.seed)
    first = np.arange(population.pairs, population.ears)
    people = np.r_[np.repeat(np.arange(population.pairs), 2), first][: population.ears]
    ages = rng.integers(35, 85, people.max() + 1)

    def alike(sd: float, columns: int) -> Array:
        """Return normal draws (ears, columns) that are correlated between the ears of a person."""
        common = rng.standard_normal((people.max() + 1, columns))[people]
        alone = rng.standard_normal((population.ears, columns))
        return np.asarray(
            sd * (np.sqrt(population.likeness) * common + np.sqrt(1.0 - population.likeness) * alone)
        )

    sizes = np.exp(alike(population.size, 1) + alike(population.stretch, 3))
    scatter, entries = alike(population.scatter, 2), alike(population.entry_scatter, 6)
    whole = population.ear.mass().mass_kg
    for k, person in enumerate(people):
        second = k > 0 and person == people[k - 1]
        right = bool(second or (person >= population.pairs and k % 3 == 0))
        stretch = (float(sizes[k, 0]), float(sizes[k, 1]), float(sizes[k, 2]))
        ear = replace(population.ear, stapes=Stapes(stretch=stretch, mirrored=right))
        size = np.log(whole * np.prod(stretch) / REFERENCE_KG)  # volumes scale with their axes
        powers = np.array(population.exponents) * size
        turn = np.array([1.0, -1.0 if right else 1.0, 1.0])
        stiff, damped = (
            population.ear.ligament.scaled(
                turn * np.exp(0.5 * (powers + scatter[k, j] + entries[k, 3 * j : 3 * j + 3]))
            )
            for j in (0, 1)
        )
        ligament = replace(stiff, damping_si=damped.damping_si)
        yield Member(
            name=f"ear{k + 1:02d}",
            subject=f"P{person + 1:02d}",
            age=float(ages[person]),
            ear=replace(ear, ligament=ligament),
        )
