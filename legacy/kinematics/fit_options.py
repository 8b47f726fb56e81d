"""Choices of the fit of a motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import REPEATS, ROBUST, LdvOptions
from legacy.kinematics.registration.geometry_model import GeometryPriors
from legacy.kinematics.registration.laser_errors import LaserPriors
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.spatial import DOF_NAMES


@dataclass(frozen=True)
class Options:
    """Choices of a fit.

    Attributes
    ----------
    dof : tuple of str
        In the order of DOF_NAMES.
    reference : str
        ``BODY:DOF`` for responses per unit of that motion; empty for absolute motion.
    robust : str
        ``none``, ``huber`` or ``t4``.
    calibrate : GeometryPriors or None
        Estimate the geometry together with the motion.
    repeats : str
        ``pool`` repeats and levels of each run after comparing them, or keep them ``separate`` as runs of
        their own.
    reference_noise : float
        Standard deviation of the real (= imaginary) part of the relative noise of the signal that all
        readings refer to; it enters the covariance of absolute motion.
    lasers : LaserPriors
        How well gain, phase and delay of the lasers agree.
    correct : bool
        Correct the faults that are identified by their estimates.

    Raises
    ------
    KinematicsError
        An unknown degree of freedom, robust estimator or way with repeats, or a noise of the reference that
        is no share.
    """

    dof: tuple[str, ...] = DOF_NAMES
    reference: str = ""
    robust: str = "none"
    calibrate: GeometryPriors | None = None
    repeats: str = "pool"
    reference_noise: float = 0.0
    lasers: LaserPriors = field(default_factory=LaserPriors)
    correct: bool = False

    def __post_init__(self) -> None:
        faults = []
        if self.robust not in ROBUST:
            faults.append(Fault("{robust}", f"one of {', '.join(ROBUST)}", self.robust))
        if self.repeats not in REPEATS:
            faults.append(Fault("{repeats}", f"one of {', '.join(REPEATS)}", self.repeats))
        if not 0.0 <= self.reference_noise < 1.0:
            faults.append(Fault("{reference_noise}", "from 0 to below 1", f"{self.reference_noise:g}"))
        if not self.dof or tuple(name for name in DOF_NAMES if name in self.dof) != self.dof:
            faults.append(Fault("dof", f"names in the order {', '.join(DOF_NAMES)}", self.dof))
        raise_all(KinematicsError, faults)

    @property
    def laser_priors(self) -> LaserPriors:
        """The priors of the lasers without the gain where a calibration estimates that."""
        return self.lasers if self.calibrate is None else replace(self.lasers, gain_sd_percent=0.0)


def fit_options(options: LdvOptions) -> Options:
    """Return the choices of the fit out of the options of the command or of a study."""
    usual = GeometryPriors()
    priors = GeometryPriors(
        usual.axes_sd_deg if options.axes_sd_deg is None else options.axes_sd_deg,
        usual.beam_sd_deg if options.beam_sd_deg is None else options.beam_sd_deg,
        options.gain_sd_percent,
    )
    return Options(
        options.dof,
        options.reference,
        options.robust,
        priors if options.calibrate else None,
        options.repeats,
        options.reference_noise,
        LaserPriors(options.gain_sd_percent, options.phase_sd_deg, options.delay_sd_us),
        options.correct,
    )
