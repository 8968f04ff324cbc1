"""Records and jobs, computed at once."""


from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.jobs import ChannelSamples, Executor


def everything(samples: ChannelSamples, *more: object) -> tuple[object, ...]:
    return samples.first, samples.columns.tolist(), *more


@given(counts=st.lists(st.integers(0, 300), max_size=12), capacity=st.integers(1, 500))
def test_a_job_sees_the_newest_samples_with_their_numbers(counts, capacity):
    channel = Executor().open(2, capacity)
    end = 0
    for count in counts:
        for k in range(end, end + count):
            channel.append(k, -k)
        end += count
        assert channel.submit(everything, 'x')
        channel.append(end, -end)
        begin = max(end - capacity, 0)
        numbers = range(begin, end)
        assert channel.poll() == (begin, [[*numbers], [-k for k in numbers]], 'x')
        end += 1


def test_a_job_sees_no_samples_before_those_it_needs() -> None:
    channel = Executor().open(1, 1000)
    for k in range(20):
        channel.append(k)
    for since in (15, 19, 20):
        channel.submit(everything, since=since)
        assert channel.poll() == (since, [[*range(since, 20)]])
