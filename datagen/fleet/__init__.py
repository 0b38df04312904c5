"""Many drives: each is mapped and labelled once, wherever there is a core, and results are kept by content.

A task is one drive (``task``), its work runs on any machine (``work``), an engine spreads the tasks over
processes or a Ray cluster (``engine``), and maps and labels lie in one storage under the hash of what they
were made from (``storage``). :func:`datagen.fleet.run.label_all` puts them together.
"""
