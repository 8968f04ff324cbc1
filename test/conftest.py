"""Settings for all tests: property tests draw the same examples on every machine and run."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    'repeatable', derandomize=True, database=None, deadline=None, max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],  # it measures time, which no test here may
)
# For a hunt by hand: pytest --hypothesis-profile=search
settings.register_profile('search', deadline=None, max_examples=1000)
settings.load_profile('repeatable')
