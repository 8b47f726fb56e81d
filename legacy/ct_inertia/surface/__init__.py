"""Triangle surfaces: extraction, exact moments, fields on them, display meshes."""
