"""Tuning constants of the estimator; those of a single formula stand beside it."""

# --- when an estimate counts as known
STD_SLOPE = 0.2  # largest std_m / m of an estimate that is published
STD_GAP = 0.3  # the same for gap and crossings, over the gap; a third if residuals correlate
REVERSALS = 2  # reversals before a first estimate if G is uncertain
NEGLIGIBLE = 0.1  # unexplained motion over the gap, or gap over its first guess, that is ignored
LOST_MOTION = 0.02  # relative std of the gap of a gear from one motion to another

# --- when an explanation is accepted
CHANCE = 1e-3  # probability below which a difference of estimates is not put down to chance
BY_CHANCE = 3.0  # standard deviations by which an estimate may be off by chance
FAR_BEHIND = 30.0  # log-likelihood by which a candidate, or a fit without a walk of u, is given up
ENGAGED = 15.0  # log-likelihood by which a backlash must beat a constant u
GATE = 6.0  # standard deviations beyond which a reading is an outlier
OUTLIERS = 5  # so many readings in a row beyond the gate are not outliers
OUTLIER_SHARE = 0.2  # largest share of new readings that may be outliers
MISFIT = 3.0  # mean square of normalized new residuals that contradicts an estimate
AS_GOOD = 1.5  # ratio of RMS residuals up to which another explanation is as good
PREDICTED = 30  # samples that a new explanation must predict after a contradiction
MOST_PREDICTED = 1000  # upper limit of that number, which doubles if the last one did not last
LASTING = 8.0  # an explanation has lasted if it predicted so many times what it had to

# --- amounts of data
FIRST_FIT = 20  # samples before the first search
SHORT_RECORD = 400  # longest record in which other gaps are looked for again [samples]
GROWTH = 1.25  # growth of the record from one search to the next
BLOCKS = 16  # a refit is due after this fraction (1 / BLOCKS) of the record
FEWEST = 8  # least number of samples between two refits
HELD_REVERSALS = 6  # reversals that the record keeps, however long they take
LONGEST = 120_000  # most samples in the record
ROWS = 1500  # samples, or averaged rows, that suffice to describe a motion
