"""Documented experiments; each is a command `egosim experiment NAME` that resumes.

A module `NAME` has `run(settings)`, which trains or loads models, generates, compares and draws.
Metrics and reports of any generated clips belong to `evaluation`.

    config         settings of all experiments, which are also the command-line options
    scenes         held-out clips of the tabletop world and their scores
    training       make clips, train a denoiser
    report         scores by method, report, tables, plots, cached values
    dwm_training   models of the experiment dwm and their trainings
"""
