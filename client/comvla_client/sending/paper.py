"""As the paper sends: the payload fills the link at the reported SNR."""

from __future__ import annotations

from comvla_client.sending.plan import BasePolicy, Plan, Situation


class Paper(BasePolicy):
    """Takes the reported SNR at its word, however old it is: Eq. (4), or its framed form.

    Once a link really withholds what does not fit, a payload sized by a report of an earlier period
    is too large about half the time.
    """

    name = "paper"

    def plan(self, now: Situation) -> Plan:
        """Tokens for the capacity at the reported SNR."""
        if now.reading is None and not now.needs_snr:
            return now.unsized()
        return now.sized(now.capacity_bits(now.known(self.name).snr_db))
