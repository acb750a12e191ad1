"""Saving and restoring pytrees: what training resumes from, and what a policy is loaded from.

A run folder holds

    checkpoints/<step>/   orbax: `trainable`, `optimizer`, `counters` and `rng` (arrays), `iterator` (the position in
                          the data) and `config` (JSON), `metrics` (what the step was judged by), and digests.json, the
                          size and sha256 of every file. It appears whole or not at all
    checkpoints/damaged/  steps whose files are not those that were written, put aside
    base/                 orbax: the frozen variables, written once, with digests.json; absent when everything is
                          trained

`run` saves and restores a run's steps, `base` its frozen variables. `digests` and `steps` find those that are whole,
`retention` says which ones stay, and `storage` is what all of them ask of orbax. Weights imported from elsewhere are a
folder of their own (`dsvla_jax.weights.imported_folder`).
"""
