"""Find G(z) from v and y while v moves on one side of the gap: least squares on the output error.

    python examples/find_model.py record.csv --order 2

record.csv has the columns t, v, y, as `check_driver --drive --rising --save record.csv` writes
them: v rises without turning back, so that the gear stays engaged and u = m (v - c_r). m cannot
be told from the gain of G: the G(z) that comes out takes v as u, and m is then close to 1, or,
with --slope M (a known gear ratio), close to M.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

Array = NDArray[np.float64]


def read_record(path: Path) -> tuple[float, Array, Array]:
    """Sample period, v (N,) and y (N,), nan where lost."""
    with path.open(newline='') as file:
        rows = [(float(row['t']), float(row['v']), float(row['y'])) for row in csv.DictReader(file)]
    t, v, y = np.array(rows).T
    return float(t[1] - t[0]), v, y


def rising_part(v: Array, y: Array, settle: int) -> tuple[Array, Array]:
    """The longest run without a step down, less its beginning, where the gap is being crossed."""
    turns = np.flatnonzero(np.diff(v) < 0.0)
    borders = np.concatenate([[-1], turns, [len(v) - 1]])
    longest = int(np.argmax(np.diff(borders)))
    first, last = borders[longest] + 1 + settle, borders[longest + 1] + 1
    if last - first < 50:
        raise SystemExit('find_model.py: v does not rise for long enough: use --rising')
    return v[first:last], y[first:last]


def predict(theta: Array, v: Array, order: int) -> Array:
    """y of the model; theta: denominator, numerator, offset of u, state at the start."""
    a, b = np.append(1.0, theta[:order]), np.append(0.0, theta[order:2 * order])
    offset, state = theta[2 * order], theta[2 * order + 1:]
    response = lfilter(b, a, v - offset, zi=state)[0]
    return np.asarray(response)


def find_model(v: Array, y: Array, order: int) -> tuple[Array, Array, float]:
    """Numerator, denominator and the deviation of the residual."""
    known = np.isfinite(y)
    whole = np.interp(np.arange(len(y)), np.flatnonzero(known), y[known])
    # A first guess from y(k) = -a1 y(k-1) ... + b1 v(k-1) ... + constant.
    lags = range(1, order + 1)
    past = [-whole[order - i:len(y) - i] for i in lags] + [v[order - i:len(v) - i] for i in lags]
    columns = np.column_stack([*past, np.ones(len(y) - order)])
    guess = np.linalg.lstsq(columns, whole[order:], rcond=None)[0]
    gain = float(np.sum(guess[order:2 * order])) or 1.0
    start = np.concatenate([guess[:-1], [-guess[-1] / gain], np.zeros(order)])

    def residual(theta: Array) -> Array:
        with np.errstate(over='ignore', invalid='ignore'):
            error = (predict(theta, v, order) - whole)[known]
        return np.where(np.isfinite(error), error, 1e6)

    found = least_squares(residual, start, x_scale='jac', method='trf', max_nfev=2000)
    theta = found.x
    return theta[order:2 * order], np.append(1.0, theta[:order]), float(np.std(residual(theta)))


def main() -> None:
    """Print what belongs into the parameter file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('record', type=Path)
    parser.add_argument('--order', type=int, default=2, help='number of poles (default: 2)')
    parser.add_argument('--slope', type=float, default=1.0, help='m, if it is known (default: 1)')
    parser.add_argument('--settle', type=int, default=100,
                        help='samples to leave out after v began to rise (default: 100)')
    options = parser.parse_args()
    period, v, y = read_record(options.record)
    numerator, denominator, noise_std = find_model(
        *rising_part(v, y, options.settle), options.order
    )
    print(f'sample_period: {period:.6g}')
    print('plant:')
    print(f'  numerator: {(numerator / options.slope).tolist()}')
    print(f'  denominator: {denominator.tolist()}')
    print(f'estimator.output_noise_std: {noise_std:.2e}')


if __name__ == '__main__':
    main()
