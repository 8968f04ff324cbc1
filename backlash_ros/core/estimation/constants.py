"""What the default law is tuned by; docs/estimation.md shows this as a table.

Guards against rounding and what belongs to the structure of one computation stand where they are
used.
"""

from __future__ import annotations

# --- judgement
BY_CHANCE = 3.0  # standard deviations up to which a difference is chance
ENGAGED = 15.0  # log-likelihood by which a gap must beat a constant u
UNDECIDED_BY = 6.0  # log-likelihood by which another gap may fall behind: some 300 are compared
REVERSALS = 2  # changes of the engaged side before the first estimate, or another one: G uncertain
PRECISE_SLOPE = 0.2  # relative deviation of m below which an estimate is published
PRECISE_GAP = 0.3  # relative deviation of the gap below which it is
NO_GAP = 0.01  # of the swing of v: a gap known this well may be 0
LASTING = 1.0 / BY_CHANCE  # of these deviations: those that an error which lasts may leave
REPLACING = 0.04  # of these deviations: those of an estimate that replaces one that held
GATE = 6.0  # standard deviations of an innovation beyond which y is an outlier
OUTLIERS = 5  # outliers in a row that are none
OUTLIER_SHARE = 0.2  # share of the samples of a block, or of a record, that may be outliers
ODDS = 20.0  # against the older one of two commands that may have acted over an interval
MISFIT = 3.0  # mean normalised square of the residuals of a block that contradicts the fit
RECOVERED = 30  # samples that end a contradiction, explain it, or are to be foretold after it
AS_GOOD = 1.5  # ratio of residuals up to which another fit explains the samples as well
UNDECIDED = 100  # samples after which it is said why there is no estimate yet
NO_DATA = 20  # lost samples in a row that are worth a state
SLOW = 100  # samples that u takes at least to walk: what is faster is motion
LEAK = 5e-3  # prior of that of an integrator, per sample and per unit of the uncertainty
LAGS = (1, 2, 4, 8, 16)  # samples after which a residual is compared with itself
LINEAR = 0.5  # deviations of the noise that terms of second order in the error of G may leave

# --- effort
LONGEST = 1500  # samples of the record that is fitted; beyond it the oldest third is let go
BLOCK = (8, 64)  # samples, fewest and most, that are taken in between two solutions
BLOCK_SHARE = 16  # ... and in between: one block for so many samples of the record
BEGINNING = 0.1  # share of the record that depends on where p began which is let go for good
GROWTH = 1.4  # of the record, after which all of it is refitted
STANDS = 0.02  # deviations that a solution of Gauss-Newton steps may still move by; p0: gaps
MOVED = 0.5  # standard deviations of the gap after which all of it is refitted
FIRST_SEARCH = 20  # samples before the first search
SEARCH_GROWTH = 1.25  # of the record between two searches, until there is an estimate
SEARCHED = 400  # newest samples of the record that a search looks at, at least
MEMORIES_SEARCHED = 4  # ... in memories of G, for a first estimate
GAPS = 32  # gaps that are compared, geometric between NO_GAP and 1 times the swing of v
STARTS = 5  # places within each gap at which the play output may have begun
ZOOM = (0.2, 17)  # second look: relative reach around the best gap, and gaps within it
CANDIDATES = 3  # best gaps of a search that are fitted
FAR_CANDIDATES = 2  # ... and gaps far from them
WALKS = (0.003, 0.01, 0.03, 0.1, 0.3)  # walks of u over the record, in m times the gap
