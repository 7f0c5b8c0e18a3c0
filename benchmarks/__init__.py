"""How fast smartcam is: each figure beside a yardstick that was measured in the same run.

``python -m benchmarks`` runs all of it; ``results/benchmarks/results.md`` is what it printed.
"""

from benchmarks.malloc import settle

settle()  # in every process of the benchmarks, before anything else
