"""Writes the layout tables of docs/shm.md from the tables in the code: `python -m tests.support.shm_reference`."""

from collections.abc import Sequence

from imud.formats.ring import HEADER_FIELDS
from imud.formats.slot import PRESENT_BITS, SLOT_FIELDS, SYNC_CODES, SlotField
from imud.ledger import LEDGER_FIELDS
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "shm.md"
C_TYPES = {
    "Q": "uint64_t", "q": "int64_t", "I": "uint32_t", "H": "uint16_t", "B": "uint8_t", "d": "double", "s": "char",
}  # fmt: skip


def layout(fields: Sequence[SlotField]) -> str:
    """Rows of offset, type and name; reserved bytes are left out."""
    rows = ["| offset | type | field |", "|---|---|---|"]
    for field in fields:
        if not field.name.startswith("reserved"):
            count = f"[{field.count}]" if field.count > 1 else ""
            rows.append(f"| {field.offset} | `{C_TYPES[field.code]}{count}` | `{field.name}` |")
    return "\n".join(rows)


def tables() -> dict[str, str]:
    """Every generated part of the page by its name."""
    return {
        "header": layout(HEADER_FIELDS),
        "slot": layout(SLOT_FIELDS),
        "present": ", ".join(f"`{name}` {bit:#x}" for name, bit in PRESENT_BITS.items()),
        "sync": ", ".join(f"{code} `{sync}`" for sync, code in SYNC_CODES.items()),
        "ledger": ", ".join(f"`{name}`" for name in LEDGER_FIELDS),
    }


def filled(text: str) -> str:
    """The page with every part between its marks made anew."""
    for name, content in tables().items():
        begin, end = f"<!-- {name} -->\n", f"\n<!-- end of {name} -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}{content}{end}{after}"
    return text


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
