"""The surroundings of many worlds in one process: their ticks, files, pages and operators. Adapters."""
