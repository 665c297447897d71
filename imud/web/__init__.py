"""`imud web`: devices in the browser. A process of its own, a client of the daemon's socket like any other.

    daemon ──one connection──▶ imud.client.feed ──▶ hub ──▶ mailbox of each browser ──WebSocket──▶ page (static/)
                                                     │
                                                buckets: least and greatest value of each axis per 20 to 100 ms

    browser ──POST──▶ app ──▶ guard: Host, Origin, token ──▶ calls ──a connection each──▶ daemon

Nothing is read from the daemon while no page is shown. Every message is encoded once, whatever the number of browsers.
"""
