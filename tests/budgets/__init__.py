"""Budgets of work: what each parser of foreign bytes may take for a byte, and how that is counted.

``parsers.py`` has the parsers and hostile inputs of any size for each, ``counting.py`` counts,
``results/budgets.md`` has the budgets. ``python -m tests.budgets`` counts all of them.
"""
