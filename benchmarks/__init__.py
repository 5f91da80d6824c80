"""How fast Tutelage is, as ratios on this machine. Nothing here is asserted by a test: see docs/benchmarks.md."""
