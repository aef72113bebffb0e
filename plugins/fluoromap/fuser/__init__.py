"""From located sites and activation times to the chamber's map, its pictures and its mesh files."""
