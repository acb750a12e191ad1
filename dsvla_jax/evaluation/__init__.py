"""Closed-loop evaluation: the loop on host and device, outcomes, results, statistics, report and demo."""
