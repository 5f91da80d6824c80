"""How fast Tutelage is, as ratios on this machine. Nothing here is asserted by a test: see docs/benchmarks.md."""

import tutelage  # noqa: F401  (before torch: it says how long idle threads spin)
