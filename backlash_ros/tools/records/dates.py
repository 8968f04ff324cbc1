"""Dates and times of day as people and programs write them, in seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from math import nan

import numpy as np
from numpy.typing import NDArray


def times_of(cells: Sequence[str]) -> NDArray[np.float64]:
    """Seconds (N,) of dates, or of times of day; nan for what is none.

    All stamps of one log are of one zone. Of 3/4/2024 what is the day is told by the whole column.
    """
    parsed = [[_seconds(cell, day_first) for cell in cells] for day_first in (False, True)]
    known = [[t for t in times if t == t] for times in parsed]
    by_month, by_day = known
    day_first = len(by_day) > len(by_month) or (
        len(by_day) == len(by_month) > 0
        and max(by_day) - min(by_day) < max(by_month) - min(by_month))
    return np.array(parsed[day_first])


def _seconds(cell: str, day_first: bool) -> float:
    text = re.sub(r'( ?Z| UTC|[+-]\d\d:?\d\d)$', '', cell.strip())
    text = re.sub(r'^(\d{4})(\d\d)(\d\d)[T_ ](\d\d)(\d\d)(\d\d)', r'\1-\2-\3 \4:\5:\6', text)
    # A date, a time of day, or both.
    found = re.fullmatch(
        r'(?:(?P<a>\d{1,4})(?P<sign>[-/. ])(?P<b>\d{1,2}|[a-z]{3})[a-z]*[-/. ](?P<c>\d{1,4}))?'
        r'[t ,]*(?:(?:(?P<h>\d{1,4}):)?(?P<m>\d{1,2}):(?P<s>\d{1,2}(?:[.,:]\d+)?)'
        r'(?: ?(?P<half>[ap])\.?m\.?)?)?', text, re.IGNORECASE)
    if not text or found is None:
        return nan
    part = found.groupdict()
    hours, minutes, seconds = part['h'], part['m'], part['s']
    if hours is None and seconds is not None and seconds.isdigit():
        hours, minutes, seconds = minutes, seconds, '0'  # 23:59, but 59:59.9
    whole = 60.0 * int(minutes or 0) + float(re.sub('[,:]', '.', seconds or '0'))
    if part['half']:
        hours = str(int(hours or 0) % 12 + 12 * (part['half'].lower() == 'p'))
    days = _days(part['a'], part['b'].lower(), part['c'], part['sign'] == '.' or day_first) \
        if part['a'] else 0.0
    return 86400.0 * days + 3600.0 * int(hours or 0) + whole


def _days(a: str, b: str, c: str, day_first: bool) -> float:
    """Days since 1970."""
    months = ['jan', 'feb', 'mar', 'apr', 'may', 'jun', 'jul', 'aug', 'sep', 'oct', 'nov', 'dec']
    if b in months:
        b, day_first = str(months.index(b) + 1), True
    year, month, day = (a, b, c) if len(a) == 4 else (c, b, a) if day_first else (c, a, b)
    try:
        return date(int(year) + 2000 * (len(year) < 4), int(month), int(day)).toordinal() - 719163.0
    except ValueError:
        return nan
