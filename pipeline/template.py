"""The study file to start from."""

TEMPLATE = """\
# One ear: its micro-CT scan, its vibrometer measurement, the fit of stiffness and damping.
# Run it with:  scan2kd study.toml
# Paths are relative to this file. Lists of three numbers are x, y, z. Lines that begin with # are optional.

[study]
name = "ear 1"
# What stands here stands at the top of the report.
notes = "incus removed, cochlea closed"

[scan]
# TIFF stack, folder of slices, NRRD, MHA, NIfTI, DICOM folder, or a closed surface mesh (STL, PLY, OBJ; mm).
file = "scan.tif"
# Voxel size, mm: one number, or [x, y, z]. Needed where the file does not say it.
# spacing_mm = 0.020
# Of raw voxels without a header: how many along x, y, z (x runs fastest), uint8 to float64, little or big.
# shape = [512, 512, 600]
# dtype = "uint16"
# byte_order = "little"
# header_bytes = 0
# At least one of density_kg_m3, mass_mg, calibration; "value+-sd" states its standard deviation.
# With several, mass_mg leads, then calibration, and the report compares them.
density_kg_m3 = "1900+-60"
# mass_mg = "3.1+-0.05"
# calibration = "calibration.toml"
# Left or right ear: names z superior or inferior in the report.
# side = "left"
# Direction towards anterior in scan axes; only its sign along the footplate is used.
# anterior = [-0.9, 0.1, 0.0]
# Named points from 3D Slicer or MeshLab: anterior, posterior, superior, inferior, head, footplate_centre.
# landmarks = "landmarks.mrk.json"
# Points of the plate in the scan: name, x_mm, y_mm, z_mm [, x_ref_mm, y_ref_mm, z_ref_mm in the plate frame].
# plate_fiducials = "plate_fiducials.csv"
# A label volume made elsewhere (with or without file), and its values.
# labels = "labels.nrrd"
# stapes_label = 1
# plate_label = 2
# Help for the search: grey value between air and bone, a point inside the stapes, a part of the scan.
# threshold = 12000
# seed_mm = [4.1, 5.0, 3.2]
# box_mm = [0.0, 0.0, 0.0, 8.0, 8.0, 6.0]
# Slices in reverse order make a mirror image; this undoes it along one axis.
# mirror = "z"
# nan_as_air = false
# Point masses that move with the stapes (beads, glue): [x, y, z, mg] or [x, y, z, mg, sd], scan mm.
# add_mass = [[4.0, 5.1, 3.3, 0.02]]
# Standard deviation of the voxel size, percent.
# voxel_size_sd_percent = 0.1

[ldv]
# body, point, [x_mm, y_mm, z_mm,] dir_x, dir_y, dir_z, freq_hz, re_m_s, im_m_s [, sd_m_s] ...
file = "ldv.csv"
# Or exports of the measuring system (universal file, folder of PSV text, .mat, .h5, time series); several as
# a list ["first.uff", "second.uff"]: parts of one measurement, or runs when they measure the same points.
# Where such files do not say it: the points of each body (numbers, ranges, FILE or FILE:1-9), the excitation
# of each file, the direction towards the laser head, peak or rms, the unit of positions.
# body = { stapes = "1-10", base = "11-19" }
# run = { push = "first.uff", tilt = "second.uff" }
# beam = "z"
# amplitude = "peak"
# length_unit = "mm"
# Averages behind each value; with the coherence of the file they give its noise.
# n_avg = 20
# Of a .mat or .h5 file with names of its own: which variable is what (TOML).
# mapping = "names.toml"
# Of time series: which column is what beam at what point (CSV), and how responses are estimated:
# h1, h2, hv or lpm, averages or the spacing of lines; the period of a periodic excitation; the steps of a
# stepped sine.
# channels = "channels.csv"
# reference_channel = "force"
# frf = "h1"
# window = "hann"
# overlap = 0.5
# averages = 30
# resolution_hz = 5.0
# period_s = 0.2
# skip_periods = 1
# steps = "steps.csv"
# settle = 0.2
# frf_band_hz = [400, 5000]
# Positions of the points, where they do not stand in ldv.csv: body, point, x_mm, y_mm, z_mm [, sd_mm].
# points = "points.csv"
# Ties vibrometer and scan: name, x_mm, y_mm, z_mm, x_ref_mm, y_ref_mm, z_ref_mm [, frame, sd_mm].
# Without it, positions and directions are in the frame named by the key frame (footplate, plate or scan).
fiducials = "fiducials.csv"
# frame = "footplate"
# dof = "all"
# Responses per unit of one motion, e.g. of the base along y.
# reference = "base:y"
# Relative noise of the signal that all readings refer to.
# reference_noise = 0.002
# Against outliers: none, huber or t4.
# robust = "none"
# Columns repeat and level of the table: pool them after comparing them, or keep them separate as runs.
# repeats = "pool"
# Left-handed coordinates of the scanning head: of positions and beams, or of the positions alone.
# mirror = "x"
# mirror_points = "x"
# Points measured on the plate, laid on its surface in the scan, alone or with fiducials as a first guess:
# [name,] x_mm, y_mm, z_mm [, sd_mm]. Points on the bone, to see whether the sample moved since the scan.
# plate_points = "plate_points.csv"
# bone_points = "bone_points.csv"
# Estimate the turn between beams and positions, the direction of each laser and the points' positions
# together with the motion, within these standard deviations and the sd_mm of the points.
# calibrate = true
# axes_sd_deg = 1.0
# beam_sd_deg = 0.5
# gain_sd_percent = 0.0

[fit]
dof = ["y", "alpha", "gamma"]
# structure = "stapes"
# base = "base"
# ml (errors in variables), irls, pinv (the paper's pseudo-inverse) or constrained.
estimator = "ml"
# none or t4 (lines that lie far off lose weight; ml only).
# robust = "none"
# viscous, hysteretic, fractional or compare.
# damping = "viscous"
# Measured motion outside dof as a known inertial load: auto, load or ignore.
# inplane = "auto"
# Lines to use, and ranges to leave out, Hz.
# band_hz = [400, 5000]
# exclude_hz = [[49, 51], [990, 1010]]
# Parts of the band whose K and D are compared with those of the whole; 0: none.
# bands = 5
# Refits of simulated repetitions that check the intervals, e.g. 10000 (about 10 s); 0: none.
# monte_carlo = 0
# Of the constrained estimator: eigenvalues or psd, and bounds of entries in SI.
# constraint = "eigenvalues"
# lower = { K11 = 100.0 }
# upper = { K11 = 5000.0 }
"""
