"""A stream of decisions whose requests are sent one by one."""

import queue

from security import OBSERVATION, POLICY
from serving import DEADLINE_SECONDS, method_of


class AgentStream:
    """A call of ActStream. Many steps of one session, or of many, may be under way."""

    def __init__(self, channel):
        self._request, call = method_of(channel, POLICY, "ActStream")
        self._requests = queue.SimpleQueue()
        self.call = call(iter(self._requests.get, None), timeout=DEADLINE_SECONDS)

    def send(self, session, step):
        """Sends a request, which may be refused later."""
        self._requests.put(self._request(session_id=session, step=step, observation=OBSERVATION))

    def act(self, session, step):
        """Sends a request and returns the next answer."""
        self.send(session, step)
        return next(self.call)

    def end(self):
        """Sends no more requests. Asserts that all answers were read and the call ends well."""
        self._requests.put(None)
        assert list(self.call) == []
