"""Causes of a misfit on many channels that are ruled out before a body is called flexible.

One cause is one file with one function ``(Suspect) -> Iterator[Explanation]`` and one entry in
``explain.CAUSES``. A cause is accepted when the search finds nothing in the data without it.
"""
