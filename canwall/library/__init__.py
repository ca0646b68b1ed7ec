"""Library for scripts and notebooks: what `import canwall` offers.

Its functions do what the commands do, with the same names, and return what people go on to
compute with: DataFrames, Arrow tables, xarray Datasets, matplotlib Figures. Errors are exceptions
(`canwall.errors`). Nothing is imported here, so that each name costs only its own imports.
"""
