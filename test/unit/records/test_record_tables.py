"""Tables as people have them: separators, heads, names of columns, dates, Parquet."""

import gzip
import sys
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from backlash_ros.core.records.record import RecordError
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.records.columns import choose_columns, parse_columns, unit_of
from backlash_ros.tools.records.reading import read_record
from backlash_ros.tools.records.table import read_table

COUNT = 60
T = 0.02 * np.arange(COUNT)
V = np.round(30.0 * np.sin(9.0 * T), 3)
Y = np.round(29.0 * np.sin(9.0 * T - 0.1), 3)


def rows(line: str = '{t:.3f},{v:.3f},{y:.3f}') -> str:
    return '\n'.join(
        line.format(t=t, s=57.0 + t, v=v, y=y, ms=round(1e3 * t),
                    sec=1_700_000_000 + k // 50, us=20_000 * (k % 50),
                    nsec=20_000_000 * (k % 50), day=45e3 + t / 86400.0, later=t + 0.003)
        for k, (t, v, y) in enumerate(zip(T, V, Y, strict=True))
    ) + '\n'


def comma(text: str) -> str:
    return text.replace('.', ',')


WIZARD = (
    'Graph,3,,,,,\nItems,2,,,,MIN,MAX\n-1,7,a servo,Goal Position,#00ff00,0,\n'
    'Time[ms],Tick,Present Position,Goal Position,,,\n'
)
TABLES = {
    'plain': 't,v,y\n' + rows(),
    'columns between others': 't,speed,y,v\n' + rows('{t:.3f},7,{y:.3f},{v:.3f}'),
    'semicolons and decimal commas': 't;v;y\n' + comma(rows('{t:.3f};{v:.3f};{y:.3f}')),
    'semicolons': 't;v;y\n' + rows('{t:.3f};{v:.3f};{y:.3f}'),
    'tabs': 't\tv\ty\n' + rows('{t:.3f}\t{v:.3f}\t{y:.3f}'),
    'tabs and decimal commas': 't\tv\ty\n' + comma(rows('{t:.3f}\t{v:.3f}\t{y:.3f}')),
    'blanks': 't v y\n' + rows('{t:8.3f}  {v:9.3f} {y:9.3f}'),
    'comments': '# made in a hurry\n# rate: 50\nt,v,y\n' + rows(),
    'head in a comment': '# t v y\n' + rows('{t:.3f} {v:.3f} {y:.3f}'),
    'names and units': 'Time [s], Goal_Position (deg), Present_Position (deg)\n' + rows(),
    'camel case': 'Timestamp,targetPosition,actualPosition\n' + rows(),
    'milliseconds': 'time_ms,command,position\n' + rows('{ms},{v:.3f},{y:.3f}'),
    'topics': '__time,/joint/command/data,/joint/state/position\n' + rows(),
    'set and actual': 'time,X_SetPosition,X_ActualPosition,X_ActualVelocity\n'
                      + rows('{t:.3f},{v:.3f},{y:.3f},0.5'),
    'iso dates': 'timestamp,setpoint,actual\n'
                 + rows('2024-02-28T23:59:{s:06.3f}Z,{v:.3f},{y:.3f}'),
    'dates with a blank': 'time;op;pv\n' + rows('2024-02-28 10:00:{s:06.3f};{v:.3f};{y:.3f}'),
    'times of day': 'time,cmd,pos\n' + rows('10:00:{s:06.3f},{v:.3f},{y:.3f}'),
    'head of another program': WIZARD + rows('{ms},9,{y:.3f},{v:.3f},,,'),
    'quoted': '"t","v","y"\n' + rows('"{t:.3f}","{v:.3f}","{y:.3f}"'),
    'torn at the end': 't,v,y\n' + rows() + '9.',
    'two tables': 'Section 1\na,b\n1,2\n\nt,v,y\n' + rows(),
    'carriage returns': 't,v,y\r\n' + rows().replace('\n', '\r\n'),
    'quoted decimal commas': 'time,command,position\n'
                             + comma(rows('"{t:.3f}";"{v:.3f}";"{y:.3f}"')).replace(';', ','),
    'thousands of comments': '# 1, 2, 3\n' * 3000 + 't,v,y\n' + rows(),
    'comments between': 't,v,y\n' + rows('# 1, 2\n{t:.3f},{v:.3f},{y:.3f}'),
    'a sign behind each row': 't;v;y;\n' + rows('{t:.3f};{v:.3f};{y:.3f};'),
    'a row of units': 'Time,Setpoint,Position\n[ms],[deg],[deg]\n' + rows('{ms},{v:.3f},{y:.3f}'),
    'units without brackets': 't,v,y\ns,rad,rad\n' + rows(),
    'a head that comes again': 't,v,y\n' + rows().replace('\n0.400', '\nt,v,y\n0.400'),
    'a table of a document': '| t | v | y |\n|---|---|---|\n' + rows('|{t:.3f}|{v:.3f}|{y:.3f}|'),
    'signs of a typesetter': 't,v,y\n' + rows().replace('-', '−'),
    'thousands': 't;v;y\n' + rows('{t:.3f};{v:,.3f};{y:,.3f}'),
    'hours': 'time,sp,pv\n' + rows('0:59:{s:06.3f},{v:.3f},{y:.3f}'),
    'minutes': 'elapsed,cmd,pos\n' + rows('03:{s:06.3f},{v:.3f},{y:.3f}'),
    'twelve hours': 'time,cmd,pos\n' + rows('03/05/2024 12:00:{s:06.3f} PM,{v:.3f},{y:.3f}'),
    'day first': 'Datum;Soll;Ist\n' + rows('28.02.2024 10:00:{s:06.3f};{v:.3f};{y:.3f}'),
    'names of months': 'time,cmd,pos\n' + rows('05-Mar-2024 10:00:{s:06.3f},{v:.3f},{y:.3f}'),
    'names of a textbook': 'time,u,theta\n' + rows(),
    'one word each': 'Zeit;Sollposition;Istposition\n' + rows('{t:.3f};{v:.3f};{y:.3f}'),
    'desired and measured': 'stamp,q_des,q_meas,qd_meas\n' + rows('{t:.3f},{v:.3f},{y:.3f},0.1'),
    'date and time': 'Date,Time,SP,PV\n' + rows('2024-02-28,10:00:{s:06.3f},{v:.3f},{y:.3f}'),
    'seconds and nanoseconds': 'stamp.sec,stamp.nanosec,v,y\n'
                               + rows('{sec},{nsec},{v:.3f},{y:.3f}'),
    'microseconds since 1970': 't,v,y\n' + rows('{sec}{us:06d},{v:.3f},{y:.3f}'),
    'days since 1900': 'date,sp,pv\n' + rows('{day:.10f},{v:.3f},{y:.3f}'),
}


def written(path: Path, text: str, encoding: str = 'utf-8') -> Path:
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize('name', TABLES)
def test_a_table_is_read_as_it_is(tmp_path: Path, name: str) -> None:
    record = read_record(written(tmp_path / 'a.txt', TABLES[name]))
    assert record.sample_period == pytest.approx(0.02, rel=1e-5)
    assert (record.v.tolist(), record.y.tolist()) == (V.tolist(), Y.tolist())


@pytest.mark.parametrize('encoding', ['utf-16', 'utf-8-sig', 'latin-1'])
def test_a_text_may_be_encoded_in_other_ways(tmp_path: Path, encoding: str) -> None:
    text = 't [µs],v,y\n' + rows('{ms}000,{v:.3f},{y:.3f}')
    path = written(tmp_path / 'a.csv', text, encoding)
    assert read_record(path).y.tolist() == Y.tolist()
    path.write_bytes(gzip.compress(path.read_bytes()))
    assert read_record(path).y.tolist() == Y.tolist()


@pytest.mark.parametrize('text', [
    't,v,y\n' + rows('{t:.3f},,{y:.3f}\n{later:.3f},{v:.3f},'),
    'time,name,value\n' + rows('{t:.3f},position,{y:.3f}\n{later:.3f},command,{v:.3f}'),
])
def test_v_and_y_may_stand_in_rows_of_their_own(tmp_path: Path, text: str) -> None:
    record = read_record(written(tmp_path / 'a.csv', text))
    assert record.sample_period == pytest.approx(0.02, rel=1e-6)
    # v acts from its own time on; before the first one nobody knows it.
    assert record.v.tolist() == V[:len(record.v)].tolist()
    assert record.y.tolist() == Y[:len(record.y)].tolist()
    assert 'separate rows' in record.timing


@pytest.mark.parametrize('word', ['', 'NULL', 'NaN', 'n/a', '-', 'inf'])
def test_what_was_not_read_is_lost(tmp_path: Path, word: str) -> None:
    lines = ('t,v,y\n' + rows()).split('\n')
    for k in (5, 6, 30):
        lines[k + 1] = f'{T[k]:.3f},{V[k]:.3f},{word}'
    lines[41] = f'{T[40]:.3f},{word},{Y[40]:.3f}'
    record = read_record(written(tmp_path / 'a.csv', '\n'.join(lines)))
    assert np.flatnonzero(np.isnan(record.y)).tolist() == [5, 6, 30]
    assert record.v[40] == V[39]


def test_columns_without_names_go_by_their_number(tmp_path: Path) -> None:
    path = written(tmp_path / 'a.csv', rows())
    with pytest.raises(InputError, match='columns are 1, 2, 3; name them'):
        read_record(path)
    assert read_record(path, columns={'t': '1', 'v': '2', 'y': '3'}).y.tolist() == Y.tolist()


@pytest.mark.parametrize(('names', 'said'), [
    (('time', 'target pos (5)', 'pos (5)', 'target pos (3)', 'pos (3)'), 'several columns may be'),
    (('t', 'voltage', 'y'), 'no column is v'), (('t', 'v', 'speed'), 'no column is y'),
    (('t', 'time', 'v', 'y'), ''), (('time', 'stamp', 'v', 'y'), 'several columns may be t'),
    (('t', 'command', 'cmd', 'y'), 'several columns may be v'),
    (('t', 'xd', 'x'), 'no column is v'), (('t', 'load', 'position'), 'no column is v'),
    (('t', 'command', 'current'), 'no column is y'),
])
def test_names_that_may_mean_several_columns_are_asked_for(names, said):
    if not said:
        assert choose_columns(names, {})[0] == {'t': 't', 'v': 'v', 'y': 'y'}
        return
    with pytest.raises(RecordError, match=said) as told:
        choose_columns(names, {})
    assert '--columns "t=…,v=…,y=…"' in str(told.value)
    assert all(name in str(told.value) for name in names)


@pytest.mark.parametrize('names', [
    ('time', 'target_position', 'current_position'), ('time', 'motor_cmd', 'load_pos'),
    ('time', 'motor_angle', 'load_angle'), ('time', 'setpoint', 'process_value'),
    ('time', 'valve_demand', 'valve_position'), ('t', 'x_cmd', 'x'), ('time', 'q_d', 'q'),
    ('stamp', 'pwm', 'position'),
])
def test_names_that_people_give_are_understood(names: tuple[str, str, str]) -> None:
    for order in permutations(names):
        assert choose_columns(order, {})[0] == dict(zip('tvy', names, strict=True))


@pytest.mark.parametrize(('text', 'given'), [
    ('t=a,v=b,y=c', {'t': 'a', 'v': 'b', 'y': 'c'}),
    ('y=pos (5), v=target, of it', {'y': 'pos (5)', 'v': 'target, of it'}),
    ('v=/joint_states/a=b', {'v': '/joint_states/a=b'}),
])
def test_columns_are_named_by_role(text: str, given: dict[str, str]) -> None:
    assert parse_columns(text) == given


@pytest.mark.parametrize('text', ['', 'a,b', 'x=a', 't=', 't=a,t=b', 'a,t=b'])
def test_roles_that_are_none_are_told(text: str) -> None:
    with pytest.raises(ValueError, match='must'):
        parse_columns(text)


@pytest.mark.parametrize(('name', 'unit'), [
    ('t', None), ('Time [ms]', 1e-3), ('stamp_ns', 1e-9), ('t (µs)', 1e-6), ('time.s', 1.0),
    ('elapsed (min)', 60.0), ('items', None),
])
def test_the_unit_of_a_time_stands_in_its_name(name: str, unit: float | None) -> None:
    assert unit_of(name) == unit


@pytest.mark.parametrize(('text', 'said'), [
    ('', 'holds no table'), ('t,v,y\n', 'holds no table'), ('hello\nworld\n', 'holds no table'),
    ('t,v\n0,1\n1,2\n', 'no column is y'), ('t,v,y\n0,1,2\n', 'no motion'),
    ('t,v,y\n0,a,2\n1,b,1\n', "column 'v': 'a' in row 1 is no number"),
    ('t,v,y\nsoon,1,2\nlater,2,1\n', "'soon' in row 1 is no time"),
    ('t,v,y\n0,1,2\n0,1,3\n', 't does not move'),
    ('t,v,y\ninf,1,2\ninf,2,3\n0,3,4\n', 't does not move'),
    ('t,v,y\n0,1,\n1,2,\n', 'y holds no number'), ('t,v,y\n0,,1\n1,,1\n', 'v holds no number'),
    ('t,v,y\n0,1,1\n1,1,2\n', 'v does not move'),
    ('t,v,y\n0,1,2\n1,1e300,2\n', 'v reaches 1e+300'),
    ('t,v,y\n0,1,0\n1,2,1e-300\n', 'y reaches 1e-300'),
])
def test_of_what_makes_no_sense_one_line_is_said(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as told:
        read_record(written(tmp_path / 'a.csv', text))
    assert said in str(told.value)
    assert '\n' not in str(told.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300) | st.text(alphabet='tvy,;.\t0123456789-e\n "na#', max_size=300))
def test_any_file_is_read_or_refused(tmp_path: Path, content: bytes | str) -> None:
    path = tmp_path / 'a.csv'
    path.write_bytes(content if isinstance(content, bytes) else b't,v,y\n' + content.encode())
    try:
        record = read_record(path)
    except InputError:
        return
    assert np.isfinite(record.v).all()
    assert record.v.shape == record.y.shape


def test_parquet_is_read_where_pyarrow_is_installed(tmp_path, monkeypatch):
    pyarrow = pytest.importorskip('pyarrow')
    from pyarrow import parquet
    stamps = (1_700_000_000_000_000_000 + np.round(T * 1e9)).astype('datetime64[ns]')
    for t in (T, stamps):
        parquet.write_table(
            pyarrow.table({'time': t, 'setpoint': V, 'actual': Y, 'note': ['x'] * COUNT}),
            tmp_path / 'a.parquet')
        record = read_record(tmp_path / 'a.parquet')
        assert record.sample_period == pytest.approx(0.02, rel=1e-6)
        assert record.y.tolist() == Y.tolist()
    monkeypatch.setitem(sys.modules, 'pyarrow', None)
    with pytest.raises(RecordError, match='pip install pyarrow'):
        read_table(tmp_path / 'a.parquet')
