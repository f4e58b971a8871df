"""The languages. Each module has `emit(programs)`: relative path below generated/ -> file text."""
