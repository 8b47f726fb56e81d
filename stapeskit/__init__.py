"""From a micro-CT and a 3D laser Doppler vibrometer to mass, stiffness and damping of a stapes."""

__version__ = "0.1.0"
