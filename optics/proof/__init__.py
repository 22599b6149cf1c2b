"""The proof: does the verdict tell the truth? Effects are hidden in captures, the loop runs blind on each, and its
verdicts are counted.

    python -m optics.proof -o renders/proof --rounds 40        (make proof)

    makers   independent renderers of captures, which share nothing with the model
    rigs     sensors and benches: what can be hidden in their captures, and which maker makes them
    cells    the plan: which effect, how strong, under which clutter, by which law, with which seed; any first part of
             it is balanced
    blind    the loop on one cell, and its record: one JSON file, so that a run can be stopped and taken up again
    count    records to rates with intervals, against the targets
    page     the tables and figures as one HTML page
"""
