"""Errors of a measurement or its model: their catalogue, their scores, and the identification of one."""
