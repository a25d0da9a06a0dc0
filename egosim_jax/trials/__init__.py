"""Trials of policies in a world: success with intervals, and where the world may be wrong.

- `policies`: policies by name: MODULE:NAME, OpenPI's server, the scripted ones.
- `starts`: scenes in which trials begin.
- `trial`: one policy, one task, one start, as a journaled session.
- `evaluation`: all trials in batches; an interrupted run resumes.
- `agreement`: distances between predicted motion, state and ground truth.
- `report`: tables, report.json and the page. `record`: LeRobot datasets.
"""
