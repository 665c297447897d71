"""Products of firmware images."""

import pytest

from imud.contracts.firmware import FirmwareImage, check_product
from imud.model.errors import BadArgument


@pytest.mark.parametrize(
    ("device", "image", "fits"),
    [
        ("HI14R3", "HI14R3", True), ("HI14R3", "HI14", True), ("HI14", "HI14R3", True), ("HI14R3", "HI14R2", False),
        ("HI14R3-URT-000", "HI14R3", True), ("hi14r3-urt-000", "HI14", True), ("HI14R2-URT-000", "HI14R3", False),
        ("HI13R3-URT-000", "HI14R3", False),
    ],
)  # fmt: skip
def test_suffix_of_an_order_code_is_no_other_product(device: str, image: str, fits: bool) -> None:
    made = FirmwareImage(0, f" {image} ".encode())
    assert made.products() == [image]
    if fits:
        check_product(made, device, "")
    else:
        with pytest.raises(BadArgument, match=f"expected an image for {device}, got an image that names {image}"):
            check_product(made, device, "")


def test_two_different_suffixes_are_two_products() -> None:
    nameless = FirmwareImage(0, bytes(8))
    check_product(nameless, "HI14R3-URT-000", "HI14R3-URT-000")
    with pytest.raises(BadArgument, match="expected an image for HI14R3-URT-000, got an image for HI14R3-CAN-000"):
        check_product(nameless, "HI14R3-URT-000", "HI14R3-CAN-000")
