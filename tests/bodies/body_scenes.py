"""Scenes with a known truth for the tests of find and grey: blurred balls, ears by the simulator."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import erf

from ct_inertia.bodies import Box, Cells, Labelled
from ct_inertia.find.plate import drawn_plate
from ct_inertia.scan.scan import Scan
from simulate.ear import Ear
from simulate.scanner import Scan as Scanner
from simulate.scanner import render

AIR, BONE = 8000.0, 30000.0


def blurred_ball(points, centre, radius, sigma):
    """Share of a ball blurred by a Gaussian at points (..., 3): its convolution in closed form."""
    r = np.maximum(np.linalg.norm(points - centre, axis=-1), 1e-9)
    low, high = (r - radius) / sigma, (r + radius) / sigma
    edges = 0.5 * (erf(high / np.sqrt(2.0)) - erf(low / np.sqrt(2.0)))
    return edges - sigma / (r * np.sqrt(2.0 * np.pi)) * (np.exp(-0.5 * low**2) - np.exp(-0.5 * high**2))


def grid_points(shape, spacing):
    """Centres (z, y, x, 3) in x, y, z of the voxels of a grid."""
    z, y, x = np.meshgrid(
        *(np.arange(n) * h for n, h in zip(shape, spacing[::-1], strict=True)), indexing="ij"
    )
    return np.stack([x, y, z], axis=-1)


@dataclass
class Ball:
    """A ball in the middle of a box; lengths in mm."""

    radius: float = 0.35
    voxel: float = 0.025
    blur: float = 1.1
    noise: float = 0.02
    seed: int = 0
    margin: float = 0.3

    @property
    def spacing(self):
        return np.full(3, self.voxel)

    @property
    def sigma(self):
        """Blur with the voxel, mm: that of sampled values is all of it."""
        return self.blur * self.voxel

    @property
    def shape(self):
        n = int(np.ceil(2.0 * (self.radius + self.margin) / self.voxel))
        return n, n + 2, n + 4

    @property
    def centre(self):
        rng = np.random.default_rng([7, self.seed])
        return 0.5 * (np.array(self.shape[::-1]) - 1.0) * self.voxel + rng.uniform(-0.5, 0.5, 3) * self.voxel

    @property
    def volume(self):
        return 4.0 / 3.0 * np.pi * self.radius**3

    def share(self, radius=None, centre=None):
        points = grid_points(self.shape, self.spacing)
        centre = self.centre if centre is None else centre
        return blurred_ball(points, centre, self.radius if radius is None else radius, self.sigma)

    def grey(self, share):
        rng = np.random.default_rng([11, self.seed])
        noise = self.noise * rng.standard_normal(share.shape)
        return (AIR + (BONE - AIR) * (share + noise)).astype(np.float32)


def labelled(grey, spacing, stapes, other=None, plate=None, plastic=None, noise=None, measured=None):
    """Labels on grey values [z, y, x], as find gives them."""
    transform = np.diag([*spacing, 1.0])
    nothing = np.zeros(grey.shape, dtype=bool)
    no = np.zeros(3, dtype=bool)
    box = Box(
        shape=grey.shape,
        first=np.zeros(3, dtype=np.int64),
        block=np.ones(3, dtype=np.int64),
        spacing_mm=spacing,
        scan_from_index=transform,
        begins=no,
        ends=no,
        grey=grey,
        measured=measured,
    )
    return Labelled(
        box=box,
        stapes=stapes,
        other=nothing if other is None else other,
        plate=nothing if plate is None else plate,
        cells=Cells(np.zeros(box.shape, dtype=np.uint8), box),
        plate_region=None if plate is None else drawn_plate(plate, box),
        air=AIR,
        bone=BONE,
        plastic=plastic,
        noise=0.02 * (BONE - AIR) if noise is None else noise,
        separation="by hand",
    )


@cache
def ear(voxel_um=40.0, noise=0.03, seed=1, spacing_factor=1.0, **parts):
    """A scan of a simulated ear, and the placed bodies behind it."""
    scanner = Scanner(voxel_um=voxel_um, noise=noise, seed=seed, tilt_deg=10.0)
    placed = scanner.placed(Ear(**parts))
    grey = render(placed, scanner)
    return Scan.from_array(grey, np.asarray(placed.voxel_mm) * spacing_factor), placed


def true_moments(placed):
    """Exact moments of the stapes of a placed ear."""
    return placed.solids[0][0].moments()
