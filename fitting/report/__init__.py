"""kd.json, kd.html and the figures of a fit."""
