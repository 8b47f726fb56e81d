"""K, D and M with covariance as a MATLAB file (level 5)."""

from __future__ import annotations

import io

import numpy as np

from legacy.fitting.exports.joint import joint_parameters
from legacy.fitting.kd_fit import KDFit


def content(fit: KDFit) -> bytes:
    """Return matrices, standard deviations and the joint covariance, SI."""
    from scipy.io import savemat

    stiffness_sd, damping_sd = fit.standard_deviation
    joint = joint_parameters(fit)
    stream = io.BytesIO()
    savemat(
        stream,
        {
            "K": fit.stiffness,
            "K_sd": stiffness_sd,
            "D": fit.damping,
            "D_sd": damping_sd,
            "M": fit.mass,
            "dof": np.array(fit.dof, dtype=object),
            "damping_law": fit.law.name,
            "damping_exponent": fit.law.time_power,
            "parameters": np.array(joint.names, dtype=object),
            "values": joint.values[:, None],
            "covariance": joint.covariance,
            "readme": "SI; about the footplate centre in footplate axes; Z(w) = K + s(w) D, e^(+iwt)",
        },
        oned_as="column",
    )
    return stream.getvalue()
