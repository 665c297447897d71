"""Words of the IMU61x on SPI, as the manual prints them."""

from imud.devices.imu61x.spi import words


def test_words_of_the_manual_and_their_answers() -> None:
    """2.4.4: 0xFE01 opens window 1. 2.4.2: 0x8644 sets both filters to 10 Hz, 0x0600 reads them back."""
    assert words.OPEN == 0xFE01
    assert words.write(0x06, 0x44) == 0x8644
    assert words.read(0x06) == 0x0600
    assert [one.hex() for one in words.READ_STATE.sends] == [
        "fe01", "6a00", "6c00", "6e00", "7000", "0600", "0c00", "0d00", "fe00", "7e00", "7e00", "7e00"
    ]  # fmt: skip
    assert words.answers(bytes.fromhex("aaaa bbbb 0001 fffe")) == (1, 0xFFFE)
    assert words.answers(b"\x01\x02\x03\x04\x05") == ()
