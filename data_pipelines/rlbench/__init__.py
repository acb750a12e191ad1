"""Demonstrations of RLBench and its forks for PerAct and PerAct2, imported without RLBench."""
