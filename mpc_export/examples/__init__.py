"""Scripts that an export bundle carries in examples/: each needs this bundle and the package that
it is named after."""
