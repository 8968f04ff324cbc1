"""What check_driver refuses before it begins."""

import pytest

from backlash_ros.nodes.check_driver import main


@pytest.mark.parametrize(('options', 'word'), [
    (['--amplitude', '3'], 'give --drive'),
    (['--duration', '-1'], 'must be finite and > 0'),
])
def test_bad_options_are_one_line_and_code_2(capsys, options, word):
    with pytest.raises(SystemExit) as left:
        main(options)
    told = capsys.readouterr().err
    assert left.value.code == 2
    assert word in told
    assert len(told.splitlines()) == 1
