"""The command line: one file per verb, each a thin shell over a Python function.

The only place that imports ``datagen``. The verbs for one's own drive are here, those of the car in
:mod:`lanenet.cli.car`, those for experiments in :mod:`lanenet.cli.research`.
"""
