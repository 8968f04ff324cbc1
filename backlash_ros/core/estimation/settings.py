"""What the estimator is tuned by; what belongs to one formula alone stands there by name."""

# --- what counts as known
STD_SLOPE = 0.2  # standard deviation of m over m, below which an estimate is published
STD_GAP = 0.3  # that of gap and crossings over the gap: BY_CHANCE of them if residuals correlate
REVERSALS = 2  # changes of the engaged side before a first estimate where G is uncertain
NEGLIGIBLE = 0.1  # motion that nothing explains, or a gap, that counts as none: over the gap
LOST_MOTION = 0.02  # by which the gap of a gear differs from one motion to another, over the gap

# --- when an explanation counts
CHANCE = 1e-3  # probability below which a difference between two estimates is no chance
BY_CHANCE = 3.0  # standard deviations by which an estimate may be off by chance
FAR_BEHIND = 30.0  # log-likelihood by which a candidate, or no walk of u, is given up
ENGAGED = 15.0  # log-likelihood by which a backlash must beat a constant u
GATE = 6.0  # standard deviations beyond which a reading is an outlier
OUTLIERS = 5  # readings in a row beyond the gate that are no outliers
OUTLIER_SHARE = 0.2  # of a block or record, up to which readings beyond the gate are outliers
MISFIT = 3.0  # mean square of normalised residuals of a block that contradicts an estimate
AS_GOOD = 1.5  # ratio of residuals up to which another explanation is as good
PREDICTED = 30  # samples that an explanation must predict after one that was contradicted
MOST_PREDICTED = 1000  # as many at most: twice as many as the last one if that did not last
LASTING = 8.0  # times what it had to predict, over which an explanation holds for long

# --- how much is looked at
FIRST_FIT = 20  # samples before the first search
SHORT_RECORD = 400  # samples of a record in which other gaps are looked for again
GROWTH = 1.25  # of the record from one search to the next
BLOCKS = 16  # refits while the record doubles: one for so many of its samples
FEWEST = 8  # samples between two refits
HELD_REVERSALS = 6  # reversals that the record holds, however long they take
LONGEST = 120_000  # samples of the record, at most
ROWS = 1500  # samples, or rows that they are averaged to, that tell what can be told of a motion
