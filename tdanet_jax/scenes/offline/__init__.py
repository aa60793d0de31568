"""Import and export of the original offline data, in the layout of SAVN, MJOLNIR and SSNet."""
