"""The report page's section on probes and grids, and heat maps. The only files of this room that draw."""
