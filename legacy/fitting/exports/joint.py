"""M, K, D and the shared errors that move them, with one covariance of them all."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.parameter_vector import join, pairs, vector
from legacy.stapeskit.arrays import Array


@dataclass(frozen=True)
class JointParameters:
    """Entries of K, D and M and the shared errors.

    Attributes
    ----------
    names : tuple of str, (p,)
    values : ndarray, (p,)
        SI; a shared error is the part that the data leave unknown, of mean 0.
    covariance : ndarray, (p, p)
        SI.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array


def joint_parameters(fit: KDFit) -> JointParameters:
    """Gather K, D, M and the shared errors of a fit with their joint covariance."""
    n = len(fit.dof)
    mass_names = [f"M{row + 1}{column + 1}" for row, column in pairs(n)]
    names = [*fit.parameters, *mass_names]
    count, entries = len(fit.parameters), len(names)
    total = entries + sum(len(effect.names) for effect in fit.budget.effects)
    covariance = np.zeros((total, total))
    covariance[:count, :count] = fit.covariance
    at = entries
    for effect in fit.budget.effects:
        by_mass = np.array([vector(part) for part in effect.mass]).reshape(-1, len(mass_names)).T
        carried = np.vstack([effect.parameters, by_mass]) @ effect.covariance
        covariance[count:entries, :entries] += by_mass @ carried.T
        covariance[:count, count:entries] += carried[:count] @ by_mass.T
        size = len(effect.names)
        if size:
            covariance[:entries, at : at + size] = carried
            covariance[at : at + size, :entries] = carried.T
            covariance[at : at + size, at : at + size] = effect.covariance
        counts: dict[str, int] = {}
        for name in effect.names:
            counts[name] = counts.get(name, 0) + 1
            names.append(f"{name}#{counts[name]}" if effect.names.count(name) > 1 else name)
        at += size
    values = np.concatenate([join(fit.stiffness, fit.damping), vector(fit.mass), np.zeros(total - entries)])
    return JointParameters(tuple(names), values, 0.5 * (covariance + covariance.T))


def content(fit: KDFit) -> bytes:
    """Return them as JSON."""
    joint = joint_parameters(fit)
    record = {
        "schema": "stapeskit.joint/1",
        "dof": list(fit.dof),
        "about": "footplate_centre",
        "axes": "footplate",
        "damping_law": fit.law.name,
        "parameters": list(joint.names),
        "values_si": joint.values.tolist(),
        "covariance_si": joint.covariance.tolist(),
    }
    return (json.dumps(record) + "\n").encode()
