"""Evaluation of generated clips: scores against the ground truth by method, and their tables.

Every {id}.mp4 in one or several folders is compared with the recorded video of its metadata row,
over the same frames and at one size. Baselines are compared, too: the prior, the prior with a
least-squares color fit, and the first frame of the ground truth repeated. Frame 0 is excluded
unless the protocol says otherwise, because it is given. Experiments (`experiments`) do not belong
here.

    evaluate     compare a folder of clips with their ground truth
    methods      rows of a table: folders of clips, and baselines
    measures     columns of a table: pixels, LPIPS, DreamSim
    estimated    columns that need estimates: regions, depth, cameras, hands
    fvd          Fréchet video distance
    scoring      Protocol, Scoring: score methods on clips
    registration, cache   crops that images show; scores by content
    result       Evaluation: summaries, paired differences, report
    tables       the papers' tables
    files        report.json, metrics.jsonl, scores.csv, table.tex, scores.png
    pages        index.html
    metrics      the formulas, on arrays
"""
