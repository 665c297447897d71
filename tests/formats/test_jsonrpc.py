"""Requests and replies of the socket as bytes, and the error of each invalid request."""

import pytest

from imud.formats import jsonrpc
from imud.formats.jsonrpc import Code, RpcError, RpcRequest
from imud.formats.slot import SLOT_BYTES

HEAD = b'{"jsonrpc":"2.0","id":1,"method":"m","params":'


@pytest.mark.parametrize(
    ("line", "code", "request_id", "words"),
    [
        (b"\xff", -32700, None, "not JSON"), (HEAD + b"NaN}", -32700, None, "not JSON"),
        (b"7", -32600, None, "expected one JSON object per line, got a number"), (b"[]", -32600, None, "got an array"),
        (b'"x"', -32600, None, "got a string"), (b"true", -32600, None, "got a boolean"),
        (b'{"jsonrpc":2.0,"id":1}', -32600, 1, 'jsonrpc: expected the string "2.0"'),
        (b'{"jsonrpc":"2.0","id":"a"}', -32600, "a", "method: expected a string, got null"),
        (b'{"jsonrpc":"2.0","id":1.5,"method":{}}', -32600, 1.5, "method: expected a string, got an object"),
        (b'{"jsonrpc":"2.0","id":true,"method":"m"}', -32600, None, "id: expected a string, a number or null, got a b"),
        (b'{"jsonrpc":"2.0","id":{},"method":"m"}', -32600, None, "id: expected a string, a number or null, got an o"),
        (HEAD + b'"x"}', -32600, 1, "params: expected an object, got a string"),
        (HEAD + b"[1]}", -32602, 1, "params: expected an object with the parameters by name"),
        # at most 64 arrays and objects and 2048 commas, docs/socket.md
        (HEAD + b'{"a":' + b"[" * 63 + b"]" * 63 + b"}}", -32700, None, "nested too deeply: expected at most 64"),
        (HEAD + b'{"a":[' + b"1," * 2046 + b"1]}}", -32700, None, "too many values: expected at most 2048"),
    ],
)  # fmt: skip
def test_an_invalid_request_has_a_code_and_its_id(line: bytes, code: int, request_id: object, words: str) -> None:
    with pytest.raises(RpcError) as error:
        jsonrpc.parse_request(line)
    assert (error.value.code, error.value.request_id) == (code, request_id)
    assert words in str(error.value)


def test_requests_within_the_limits_are_accepted_and_messages_are_bytes() -> None:
    """Integers that can exceed 2⁵³ are strings on request: `epoch` and times in ns (docs/socket.md)."""
    assert jsonrpc.parse_request(b'{"jsonrpc":"2.0","method":"m"}') == RpcRequest("m", {}, None, wants_reply=False)
    assert jsonrpc.parse_request(HEAD + b'{"a":2}}') == RpcRequest("m", {"a": 2}, 1, wants_reply=True)
    assert jsonrpc.parse_request(HEAD + b'{"a":' + b"[" * 62 + b"]" * 62 + b"}}").request_id == 1
    assert jsonrpc.parse_request(HEAD + b'{"a":[' + b"1," * 2045 + b"1]}}").request_id == 1
    with pytest.raises(RpcError, match=r"^cannot read the JSON: nested too deeply$"):
        jsonrpc.parse_object(b"[" * 100_000)
    assert jsonrpc.encode_request("m", {"a": 2}, 1) == HEAD + b'{"a":2}}'
    value = {"epoch": 1, "t_ns": 2**60, "seq": 5, "list": [{"utc_ns": -1, "is_ns": True}], "r_ns": 1.5, "x_ns": None}
    plain = b'{"epoch":1,"t_ns":%d,"seq":5,"list":[{"utc_ns":-1,"is_ns":true}],"r_ns":1.5,"x_ns":null}' % (2**60)
    texts = b'{"epoch":"1","t_ns":"%d","seq":5,"list":[{"utc_ns":"-1","is_ns":true}],"r_ns":1.5,"x_ns":null}' % (2**60)
    for is_text, body in ((False, plain), (True, texts)):
        assert jsonrpc.encode_result("a", value, texts=is_text) == b'{"jsonrpc":"2.0","id":"a","result":' + body + b"}"
        notified = jsonrpc.encode_notification("event", value, texts=is_text)
        assert notified == b'{"jsonrpc":"2.0","method":"event","params":' + body + b"}"
    assert jsonrpc.encode_result(2, {"t_ns": 1}) == b'{"jsonrpc":"2.0","id":2,"result":{"t_ns":1}}'
    assert jsonrpc.encode_notification("event", {"t_ns": 1}).endswith(b'"params":{"t_ns":1}}')
    for data, more in ((None, b""), ({"a": 1}, b',"data":{"a":1}')):
        error = jsonrpc.encode_error(RpcError(Code.INVALID_PARAMS, "no", 4, data))
        assert error == b'{"jsonrpc":"2.0","id":4,"error":{"code":-32602,"message":"no"%b}}' % more
    assert jsonrpc.line_of(b"{}") == b"{}\n"
    assert jsonrpc.frame_of(b"{}") == b"\3\0\0\0{}\n"
    whole = b"x" * (SLOT_BYTES - 1)  # a multiple of the size of a slot would be slots
    assert jsonrpc.frame_of(whole) == (SLOT_BYTES + 1).to_bytes(4, "little") + whole + b"\n\n"
    assert (jsonrpc.PROTOCOL, jsonrpc.LINE_MAX_BYTES, jsonrpc.FRAME_MAX_BYTES) == (1, 65_536, 16_777_216)
