"""Recognise the columns of time, command v and output y by their names."""

import re
from collections.abc import Mapping, Sequence

ROLES = ('t', 'v', 'y')
COMMAND = 'command'  # a fourth one, if v is what a motor encoder reports

# Patterns of names, most certain first: the first that fits any column decides.
PATTERNS: Mapping[str, Sequence[str]] = {
    't': (
        r't', r'time|timestamp|time stamp|stamp|uhrzeit',
        r'elapsed( time)?|secs?|seconds|uptime|date ?time|zeit',
        r'(.* )?(time|timestamp|stamp)( s| secs?| us| ms| ns)?', r'(ms|us|ns|millis|micros)',
        r'date|datum',
    ),
    'v': (
        r'v', r'command|cmd|control|goal|target|set ?point|demand|sp|op|soll(wert)?|u|input',
        r'(.* )?(goal|target|commanded|commands?|cmd|desired|des|set ?point|set|demand|soll\w*'
        r'|control)( .*)?', r'ref(erence)?( .*)?|.* (ref(erence)?|u|v|d|input)',
        r'(.* )?motor( .*)?',
    ),
    'y': (
        r'y', r'position|pos|actual|measured|present|feedback|output|encoder|angle|pv|process value'
        r'|ist(wert)?',
        r'(.* )?(actual|present|measured|meas|feedback|ist\w*)( .*)?',
        r'(.* )?(positions?|pos|output|encoder|angle|theta|q)( .*)?|.* y',
    ),
}
# Names that are neither v nor y, whatever else they contain.
OTHERS = r'.*\b(qd|dq|speed|velocity|vel|(load|current)(?! (pos(ition)?|angle|encoder))|torque' \
         r'|effort|temp(erature)?|voltage|status|moving|err(or)?|acceleration|acc|power|rate' \
         r'|direction|duration)\b.*'
UNITS_S = {unit: scale for scale, units in {
    1e-9: 'ns nsec nanoseconds', 1e-6: 'us µs μs usec microseconds micros',
    1e-3: 'ms msec milliseconds millis', 1.0: 's sec secs seconds', 60.0: 'min minutes',
    3600.0: 'h hours', 86400.0: 'd days',
}.items() for unit in units.split()}


def parse_columns(text: str) -> dict[str, str]:
    """Parse `t=NAME,v=NAME,y=NAME`, in any order, into names by role; raises ValueError."""
    parts = re.split(rf'(?:^|,)\s*({"|".join((*ROLES, COMMAND))})=', text)
    if parts[0] or len(parts) < 3:
        raise ValueError(f'{text!r} must be like t=NAME,v=NAME,y=NAME')
    given = {role: name.strip() for role, name in zip(parts[1::2], parts[2::2], strict=True)}
    if len(given) < len(parts) // 2 or not all(given.values()):
        raise ValueError(f'{text!r} must name one column each')
    return given


def choose_columns(names: Sequence[str], given: Mapping[str, str]) -> tuple[dict[str, str], str]:
    """Choose the columns of a table by role; also returns what was guessed as text, or ''.

    given: columns by role that the user has chosen. Raises RecordError, with the names of all, if a
    role fits no column or several.
    """
    from backlash_ros.core.records.record import RecordError  # loads NumPy

    for role, name in given.items():
        if name not in names:
            raise RecordError(f'--columns {role}={name}: {columns_of(names)}')
    found = dict(given)
    for role, meant in (('t', 'the time'), ('v', 'the command'), ('y', 'the output')):
        if role in found:
            continue
        fitting = _fitting(role, names, found)
        if not fitting and role != 't' and len(names) == 3:
            # Of three columns the one that is left over.
            neither = {*found.values(), *_fitting('y' if role == 'v' else 'v', names, found)}
            left = [name for name in names
                    if name not in neither and not re.fullmatch(OTHERS, _words(name))]
            fitting = left if len(left) == 1 else []
        if len(fitting) == 1:
            found[role] = fitting[0]
        elif role != 't' or fitting:
            why = 'several columns may be' if fitting else 'no column is'
            raise RecordError(f'{why} {role}, {meant}: {columns_of(names)}; name them: '
                              '--columns "t=…,v=…,y=…"')
    if COMMAND in names and found['v'] == 'v':
        found.setdefault(COMMAND, COMMAND)
    said = ', '.join(f'{role} is {found[role]!r}' for role in ROLES
                     if role not in given and found.get(role, role) != role)
    return found, f'columns: {said}; --columns chooses others' if said else ''


def columns_of(names: Sequence[str]) -> str:
    """The names of the columns, in words."""
    shown = ', '.join(names[:14]) + (f', … ({len(names)} in all)' if len(names) > 14 else '')
    return f'the columns are {shown}'


def unit_of(name: str) -> float | None:
    """Unit [s] in the name of a time column, as in `Time [ms]` or `stamp_ns`; None if none."""
    bracketed = re.search(r'[\[(]\s*([^\])]+?)\s*[\])]', name)
    word = bracketed.group(1) if bracketed else re.split(r'[\s_.]', name.strip())[-1]
    return UNITS_S.get(word.lower())


def _fitting(role: str, names: Sequence[str], taken: Mapping[str, str]) -> list[str]:
    """Columns that may have this role, by the most certain pattern that fits any."""
    words = {name: _words(name) for name in names if name not in taken.values()}
    found = ([name for name, text in words.items() if re.fullmatch(pattern, text)
              and (role == 't' or not re.fullmatch(OTHERS, text))] for pattern in PATTERNS[role])
    return next(filter(None, found), [])


def _words(name: str) -> str:
    """`Goal_Position [deg]`, `/goalPosition` → `goal position`."""
    name = re.sub(r'[\[(].*?[\])]', ' ', name)
    name = re.sub(r'(?<=[a-z])(?=[A-Z])', ' ', name)
    return ' '.join(re.findall(r'[^\W_]+', name.lower()))
