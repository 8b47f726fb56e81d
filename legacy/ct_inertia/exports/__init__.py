"""The stapes in the file formats of other programs: meshes, multibody models, finite elements, MATLAB."""

from legacy.ct_inertia.export_formats import FILES, FORMATS
from legacy.ct_inertia.exports.export import export, files_of, parse_formats, units_of

__all__ = ["FILES", "FORMATS", "export", "files_of", "parse_formats", "units_of"]
