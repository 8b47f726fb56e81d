"""Exports of K, D and M, one a file; fitting.export_formats is their table."""
