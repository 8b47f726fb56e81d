"""Numbers as people write them: a value with its standard deviation, powers of ten, ± and µ."""

from __future__ import annotations

import math
import re

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLUS_MINUS = re.compile(r" \+- (?=[\d.])")
# um and urad behind a number, a blank or a bracket; us, which is a word too, behind a number or alone.
_MICRO = re.compile(r"(?<=[\d (])u(?=(?:m|rad)\b)|(?<=\d )u(?=s\b)|^u(?=s$)")
_POWER = re.compile(r"(?:(?<=\bmm)|(?<=\bkg/m)|(?<=\bkg m)|(?<=\bm/s))[23]\b")


def plus_minus(value: float, sd: float | None) -> str:
    """Write a value with its standard deviation, both to the second digit of the latter.

    Parameters
    ----------
    sd : float, optional
        None, NaN or infinite: unknown.

    Examples
    --------
    >>> plus_minus(1736.4, 17.2), plus_minus(13379, 2762), plus_minus(3.0531e-08, 7.2e-10)
    ('1736 ± 17', '13400 ± 2800', '(3.053 ± 0.072)·10⁻⁸')
    >>> plus_minus(-1e-5, 0.014)
    '0.000 ± 0.014'
    """
    if sd is None or not 0.0 < sd < math.inf:
        return f"{value:.4g} ± {'0' if sd == 0.0 else 'unknown'}"
    power = math.floor(math.log10(max(abs(value), sd)))
    power = 0 if -3 < power < 6 else power
    value, sd = value * 10.0**-power, sd * 10.0**-power
    digits = 1 - math.floor(math.log10(sd))
    # A zero has no sign.
    text = " ± ".join(f"{round(number, digits) + 0.0:.{max(0, digits)}f}" for number in (value, sd))
    return text if power == 0 else f"({text})·10{str(power).translate(_RAISED)}"


def printed(text: str) -> str:
    """Return a message of the terminal with the letters that a page has: ±, µ and powers of units.

    Examples
    --------
    >>> printed("factor 1.08 +- 0.01, 0.2 urad per nm, 3 us, 2.3 mm3 (um); density RHO+-SD")
    'factor 1.08 ± 0.01, 0.2 µrad per nm, 3 µs, 2.3 mm³ (µm); density RHO+-SD'
    """
    text = _MICRO.sub("µ", _PLUS_MINUS.sub(" ± ", text))
    return _POWER.sub(lambda match: match[0].translate(_RAISED), text)
