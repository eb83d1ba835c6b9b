import pytest

from qd.show.view.address import Address, read_address


@pytest.mark.parametrize(
    "address",
    [
        Address(),
        Address(elite=12, controller="C-G", episode=3, time_s=8.4, follow=True),
        Address(elite=0, controller="as searched & more=50%", time_s=0.0, terrain="minimal"),
        Address(position="1.00,-2.50,3.25", look_at="4.00,5.00,0.00"),
    ],
)
def test_what_an_address_says_comes_back(address):
    assert read_address(address.query()) == (address, [])
    assert read_address("?" + address.query()) == (address, [])


def test_what_means_nothing_is_said_and_left_out():
    address, refused = read_address("elite=twelve&episode=1.5&t=nan&more=1")
    assert address == Address()
    assert [text.split("=")[0] for text in refused] == ["elite", "episode", "t"]
    assert Address(elite=7, time_s=1.25, follow=True).query() == "elite=7&t=1.25&follow=1"
