import socket

import pytest

from garat_jax import devices
from garat_jax.errors import UserError


@pytest.mark.parametrize(
    "address",
    ["nonsense", "localhost:", "localhost:abc", "localhost:99999999", "localhost:0", ":1234"],
)
def test_an_address_that_is_none_is_refused(address, monkeypatch):
    message = "^the coordinator is .*; expected HOST:PORT, as node1:1234$"
    with pytest.raises(UserError, match=message):
        devices.join_processes(address, 1, 0)
    monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", address)
    with pytest.raises(UserError, match=message):
        devices.join_processes(None, 1, 0)


def test_a_process_0_that_never_answers_is_named(monkeypatch):
    monkeypatch.setattr(devices, "PATIENCE", 0.1)
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(UserError, match=f"no process 0 answers at {address}"):
            devices.join_processes(address, 2, 1)


@pytest.mark.parametrize("variable", ["JAX_PROCESS_ID", "JAX_NUM_PROCESSES"])
def test_a_variable_that_is_no_number_is_refused(variable, monkeypatch):
    monkeypatch.setenv(variable, "two")
    with pytest.raises(UserError, match=f"^the variable {variable} is 'two'; expected a whole"):
        devices.join_processes("127.0.0.1:1234", None, None)


@pytest.mark.parametrize(
    ("count", "number", "message"),
    [
        (2, 5, "--process-id 5: expected 0 to 1"),
        (2, 2, "--process-id 2: expected 0 to 1"),
        (2, -1, "--process-id -1: expected 0 to 1"),
        (0, 0, "--num-processes 0: expected 1 or more"),
    ],
)
def test_a_process_that_is_none_of_them_is_refused_at_once(count, number, message, monkeypatch):
    monkeypatch.setattr(devices, "_check_address", None)  # nobody is waited for
    with pytest.raises(UserError, match=f"^{message}$"):
        devices.join_processes("localhost:1234", count, number)
    monkeypatch.setenv("JAX_NUM_PROCESSES", str(count))
    with pytest.raises(UserError, match=f"^{message}$"):
        devices.join_processes("localhost:1234", None, number)
