"""What checks types and shapes at run time while tests run."""

from beartype import BeartypeConf, beartype

# As type checkers do, it takes an int for a float.
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
