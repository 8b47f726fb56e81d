"""The example of a plan that `dof2kd --help` shows; it runs as it stands."""

from __future__ import annotations

PLAN_EXAMPLE = """dof = ["y", "alpha", "gamma"]
directions = ["y"]               # driven by the shaker, one run each
band_hz = [400, 5000]
lines = 200                      # of one run
noise_m_s = 2e-6                 # sd of Re and Im; or: noise_relative = 0.05
base_velocity_m_s = 6e-4         # along the driven direction
rocking = 0.05                   # of the base in the others, at 1 mm
position_sd_mm = 0.03            # of each coordinate of a point
registration_sd_mm = 0.02        # of the footplate centre in the vibrometer
registration_sd_deg = 0.1        # of the footplate axes in it
gain_sd_percent = 1              # of each laser, with the next two
phase_sd_deg = 0.5
delay_sd_us = 1
mass_sd_percent = 3              # density; leave it out beside a mass.json
# mass = "mass.json"             # or a matrix, SI, order of dof (the paper's)
# stiffness = [[1722, 0.414, -0.48], [0.414, 1.37e-3, -6.41e-5],
#              [-0.48, -6.41e-5, 3.79e-3]]
# damping = [[22.89e-3, 61.42e-7, -36.79e-7], [61.42e-7, 30.15e-9, -67.56e-13],
#            [-36.79e-7, -67.56e-13, 56.46e-9]]
# structure_points_mm = [[1.2, 0.15, 0], [-1.2, 0.15, 0], [0.5, 0.15, 0.5],
#                        [0.1, 3.2, 0.2]]
# base_points_mm = [[2.5, 0.3, 0], [-2.5, 0.3, 0], [0, 0.3, 2], [0, 0.3, -2]]
"""
