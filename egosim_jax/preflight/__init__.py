"""Compilation of a program for a machine that need not be present, and a report of its costs.

Callers pass the program: nothing here knows models or training.

    targets   target machines
    report    memory, FLOPs and roofline time, and whether it fits
    flops     FLOPs of a traced program
"""
