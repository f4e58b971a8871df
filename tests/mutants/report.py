"""The table of faults by area, and the survivors."""

from __future__ import annotations

import tomllib

from faults import HERE, area

_HEADING = "| area | faults | noticed | equivalent | survived |\n|---|---:|---:|---:|---:|"


def printed(title: str, rows: list[dict[str, object]]) -> int:
    """Print counts by area, and the survivors; return 1 where one is not equivalent."""
    equivalent = {
        (entry["old"], entry["new"])
        for entry in tomllib.loads((HERE / "equivalent.toml").read_text()).get("equivalent", [])
    }
    table: dict[str, list[int]] = {}
    survivors = []
    for row in rows:
        if row["verdict"] == "invalid":
            continue
        counts = table.setdefault(area(str(row["file"]))["name"], [0, 0, 0, 0])
        survived = row["verdict"] == "survived"
        same = survived and (row["old"], row["new"]) in equivalent
        counts[0] += 1
        counts[3 if survived and not same else 2 if same else 1] += 1
        survivors += [row] if survived and not same else []
    table["all"] = [sum(column) for column in zip(*table.values(), strict=True)] or [0] * 4
    print(f"\n{title}\n\n{_HEADING}")
    for name, counts in table.items():
        print(f"| {name} | " + " | ".join(map(str, counts)) + " |")
    for row in survivors:
        print(f"\n{row['name']} {row['file']}:{row['line']}\n- {row['old']}\n+ {row['new']}")
    return int(bool(survivors))
