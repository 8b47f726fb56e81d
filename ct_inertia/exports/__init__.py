"""The stapes in the file formats of other programs: meshes, multibody models, finite elements, MATLAB."""

from ct_inertia.exports.export import FORMATS, export, parse_formats, units_of

__all__ = ["FORMATS", "export", "parse_formats", "units_of"]
