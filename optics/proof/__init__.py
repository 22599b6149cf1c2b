"""The proof: does the verdict tell the truth? Captures with hidden effects, the loop run blind on each, and what came
of it counted.

    python -m optics.proof -o renders/proof --rounds 40        (make proof)

    rigs     sensors and benches: what can be hidden in their captures, how those are made by another path than the
             model
    cells    the plan: which effect, how strong, under which clutter, by which law, with which seed; a prefix of it is
             balanced
    blind    the loop on one cell, and its record: one JSON file, so that a run can be stopped and taken up again
    count    records to rates with intervals, against the targets
    page     the tables and figures as one HTML page

Source: the diagnosis laboratory, section 5 (cells and targets).
"""
