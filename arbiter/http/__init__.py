"""The status page: one read-only page for a browser, over HTTP/1.1, and its live events.

`page` joins the parts: `server` and `connection` speak HTTP, `access` decides who may read, `feed`
sends what changed to the open pages, `usage_record` keeps the last minutes of each GPU. Off unless
`http.listen` is set, and then not imported. Must not decide anything about leases.
"""
