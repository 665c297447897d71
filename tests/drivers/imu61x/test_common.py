"""Check value, product ids and filter codes, compared with the manual."""

import pytest

from imud.drivers.imu61x import common


def crc32_bit_by_bit(data: bytes) -> int:
    register = 1
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register


@pytest.mark.parametrize("data", [b"", b"\x00", b"123456789", bytes(range(256)), b"\xff" * 44])
@pytest.mark.manual("A 5 CRC-32")
def test_crc_is_the_reflected_polynomial_from_one_without_inversion(data: bytes) -> None:
    assert common.crc32(data) == crc32_bit_by_bit(data)


@pytest.mark.manual("A 1.2 CRC", "A 1.3 acceleration", "A 2.4.2 codes", "A 2.4.2 default", "A 2.4.2 layout")
def test_crc_gravity_products_and_filters() -> None:
    """The manual has 0x44 for 10 Hz and 0xBB for 47 Hz, accelerometer in the high half byte."""
    assert common.crc32(bytes.fromhex("55AA 0300 1800 0000803F") + bytes(20)) == 0xE88ED852
    assert common.crc32(b"123456789") == 0x3A8639CB
    assert common.crc32(memoryview(b"123456789")) == 0x3A8639CB
    assert common.M_S2_PER_G == 9.80665
    with pytest.raises(ValueError, match="IMU612"):
        common.product_id_of("IMU613")
    assert len(common.PRODUCTS) == 5
    for data in (b"", bytes(8), b"\xff" * 8, b"\x00\x00IMU613", b"\x00\x00IMU614\x00", b"IMU61400"):
        assert common.product_of(data) is None
    assert (common.FILTERS[4], common.FILTERS[0xB]) == ("10 Hz", "47 Hz")
    assert len(common.FILTERS) == 16
    assert common.filter_control(4, 4) == 0x44
    assert common.filter_control(0xB, 1) == 0xB1
    assert common.filter_codes(0xB1) == (0xB, 1)
    assert common.filter_codes(0xFFB1) == (0xB, 1)
    for codes in ((-1, 0), (16, 0), (0, 16), (0, -1)):
        with pytest.raises(ValueError, match="0 … 15"):
            common.filter_control(*codes)


@pytest.mark.parametrize(
    ("product_id", "product"),
    [
        ("0000494D55363132", "IMU612"), ("0000494D55363134", "IMU614"), ("0000494D55363138", "IMU618"),
        ("0000494D55363141", "IMU6132A"), ("0000494D55363142", "IMU6132B"),
    ],
)  # fmt: skip
@pytest.mark.manual("A 2.4.3 products")
def test_product_ids_of_tables_22_and_28(product_id: str, product: str) -> None:
    assert common.product_of(bytes.fromhex(product_id)) == product
    assert common.product_id_of(product) == bytes.fromhex(product_id)
