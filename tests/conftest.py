"""One persistent compilation cache for the whole suite: what a test compiles once, no later run compiles again.

Tests spend most of their time compiling, so XLA leaves most optimisations out, here and in programs that tests start.

And run-time checks of types and shapes: of what the structs hold, and of what the functions around them take and give.
"""

import os
from pathlib import Path

import jax
from jaxtyping import install_import_hook

import tests.shape_checks  # noqa: F401  (the hook looks it up by name)

# Before any test imports one of these modules.
CHECKED = ["dsvla_jax.types", "dsvla_jax.encoding.encode", "dsvla_jax.geometry", "data_pipelines.records"]
install_import_hook(CHECKED, "tests.shape_checks.check")

jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".cache" / "xla"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
jax.config.update("jax_disable_most_optimizations", True)
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
