"""Requests to a run in progress, in the memory of one process."""

import threading

import pytest

from canwall.record import mailbox as mailbox_module
from canwall.record.mailbox import Mailbox


def test_mailbox_that_is_closed_while_a_request_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by a panel whose run ends meanwhile: there is no answer, and nothing else fails."""
    monkeypatch.setattr(mailbox_module, "_LAST_ANSWER_S", 0.05)
    mailbox = Mailbox.create()
    closing = threading.Timer(0.05, mailbox.close)
    closing.start()
    with pytest.raises(TimeoutError):
        mailbox.post("{}", 0.2)
    closing.join()
    with pytest.raises(OSError, match="Bad file descriptor"):
        mailbox.post("{}", 0.2)
