"""Check values against the published ones."""

from imud.formats.checksum import crc16_modbus, crc16_xmodem


def test_crc16_xmodem() -> None:
    assert crc16_xmodem(b"123456789", 0) == 0x31C3
    assert crc16_xmodem(b"6789", crc16_xmodem(b"12345", 0)) == 0x31C3


def test_crc16_modbus() -> None:
    assert crc16_modbus(b"123456789") == 0x4B37
    assert crc16_modbus(b"123456789\x37\x4b") == 0
