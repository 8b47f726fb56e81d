"""Measure on grey values: levels, blur, partial volume, plate face, soft surroundings."""
