"""The play operator over a record is the one that is stepped sample by sample."""

from itertools import accumulate, islice

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.plant.backlash import clamp, play

values = st.floats(-10.0, 10.0)


@given(v=st.lists(values, min_size=1, max_size=40), gaps=st.lists(
    st.floats(0.0, 5.0), min_size=1, max_size=3), before=values)
def test_stepping_the_turns_alone_leaves_nothing_out(v, gaps, before):
    stepped = [
        list(islice(accumulate(v, lambda p, x, g=gap: clamp(p, x, x + g), initial=before), 1, None))
        for gap in gaps
    ]
    assert play(np.array(v), gaps[0], before).tolist() == stepped[0]
    assert play(np.array(v), np.array(gaps), np.full(len(gaps), before)).tolist() == stepped
