"""What a controller believes of G: the coefficients, how sure they are, the noise, the rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

from backlash_ros.core.law import Law
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.scenario import build_model

# At which the response of G is judged, as shares of the sampling rate: from slow motion to where
# little is left of it.
FREQUENCIES: tuple[float, ...] = tuple(np.geomspace(0.01, 0.2, 5).tolist())
STD_LABELS = tuple(f'response_std_at_{share:.4g}_of_sampling_rate' for share in FREQUENCIES)


@dataclass(frozen=True)
class LearnedModel:
    """G(z) = z^-delay_samples numerator / denominator, in descending powers of z.

    response_std: relative standard deviation |dG/G| of the true response from it at FREQUENCIES;
    the gain at rest is part of m. noise_ratio and unexplained: as in LawReport. All three are nan
    where nothing was learned, or the law does not learn it.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    delay_samples: int
    response_std: tuple[float, ...] = (nan,) * len(FREQUENCIES)
    noise_ratio: float = nan
    unexplained: float = nan

    def fields(self) -> dict[str, tuple[float, ...]]:
        """All numbers under the labels of `controller/model`, in their order."""
        return {
            'numerator': self.numerator, 'denominator': self.denominator,
            'delay_samples': (float(self.delay_samples),),
            **{label: (std,) for label, std in zip(STD_LABELS, self.response_std, strict=True)},
            'noise_ratio': (self.noise_ratio,), 'unexplained': (self.unexplained,),
        }


def from_fields(fields: Mapping[str, Sequence[float]]) -> LearnedModel:
    """The inverse of `fields`; raises KeyError, IndexError or ValueError for what is none."""
    return LearnedModel(
        tuple(map(float, fields['numerator'])), tuple(map(float, fields['denominator'])),
        int(fields['delay_samples'][0]), tuple(float(fields[label][0]) for label in STD_LABELS),
        float(fields['noise_ratio'][0]), float(fields['unexplained'][0]),
    )


def learned_model_of(law: Law, p: Parameters) -> LearnedModel:
    """What a law believes of G now: that of the parameters where it does not learn it."""
    learned, report = law.learned_model, law.report
    model = build_model(p) if learned is None else learned.transfer_function
    response_std = law.response_std(np.exp(2j * np.pi * np.array(FREQUENCIES)))
    numerator, denominator, delay = model.without_delay()
    return LearnedModel(tuple(numerator), tuple(denominator), delay, tuple(response_std.tolist()),
                        report.noise_ratio, report.unexplained)
