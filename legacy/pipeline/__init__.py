"""The scripted chain from a study file to one report."""
