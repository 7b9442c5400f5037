"""Connections and processes that come and go, and a journal that fails.

Leases belong to processes: a connection that drops loses nothing that is resident (its process
re-attaches or the ttl runs out); `bye` gives everything back; death ends everything, and what was
held is measured away before anyone else gets it.
"""

from dataclasses import replace

from vram_arbiter.arbiter.core.events import (
    BYE,
    ClientConnected,
    ClientLeft,
    JournalFailed,
    ProcessDied,
)
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import EXPIRING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Client, Core
from vram_arbiter.arbiter.core.requests.expiry import lose
from vram_arbiter.arbiter.core.requests.recovery import account_for
from vram_arbiter.arbiter.core.requests.requests import cancel_waiter, let_go
from vram_arbiter.arbiter.core.requests.uses import end_use
from vram_arbiter.arbiter.core.verification.schedule import on_process_died
from vram_arbiter.schemas.ids import ClientId, LeaseId
from vram_arbiter.schemas.wire.codes import Why
from vram_arbiter.schemas.wire.pushes import DeniedPush


def on_connected(core: Core, event: ClientConnected) -> None:
    """A hello. The same instance on a new connection is the same client: its leases, waits and uses
    are the new connection's."""
    if event.client in core.clients:
        _forget(core, core.clients[event.client])
    instance = (event.process, event.instance)
    earlier = core.instances.get(instance)
    if earlier is not None:
        _take_over(core, earlier, event.client)
    core.join(Client(event.client, event.process, event.name, event.instance, event.uid))
    core.instances[instance] = event.client
    core.last_client_at = core.now
    for gpu in core.gpus.values():
        core.turn.touch(gpu)
        if gpu.sample is None or core.now - gpu.sample.taken_at > core.settings.sample_max_age_s:
            core.want_sample(gpu, core.now - core.settings.sample_max_age_s)


def _take_over(core: Core, earlier: ClientId, client: ClientId) -> None:
    """However often a client reconnects, only its newest connection is remembered."""
    core.part(earlier)
    mine = core.leases_of_client(earlier)
    for lease in _concerned(core, mine):
        for table in (lease.uses, lease.uses.paused):
            for key, use in table.items():
                if use.client == earlier:
                    table[key] = replace(use, client=client)
    for lease in mine:
        core.hand_to(lease, client)


def _forget(core: Core, client: Client) -> None:
    core.part(client.id)
    core.instances.pop((client.process, client.instance), None)


def on_left(core: Core, event: ClientLeft) -> None:
    """Queued leases and uses of the connection end. Resident leases end with a `bye` only."""
    client = core.clients.get(event.client)
    if client is None:
        return
    _forget(core, client)
    core.last_client_at = core.now
    for lease in _concerned(core, core.leases_of_client(event.client)):
        for use in [use for use in lease.all_uses() if use.client == event.client]:
            end_use(core, lease, use, Why.CLIENT_LEFT, event.reason)
        if lease.client != event.client or lease.process != client.process:
            continue
        if lease.state is LeaseState.QUEUED:
            cancel_waiter(core, lease, Why.CLIENT_LEFT, event.reason)
        elif lease.state not in EXPIRING:
            left = no.CancelledRequest(lease.id, Why.CLIENT_LEFT, event.reason)
            _give_up(core, lease, LeaseState.CANCELLED, left)
        elif event.reason == BYE:
            let_go(core, lease, exiting=False, why=Why.BYE)


def _give_up(core: Core, lease: Lease, to: LeaseState, refusal: no.End) -> None:
    for feature in lease.features:
        feature.give_up(core, lease, to, refusal)


def concerns(core: Core, client: ClientId) -> bool:
    """Whether a live lease, a request or a use is this client's: then losing its connection ends
    nothing."""
    if core.count_of_client(client):
        return True
    return any(use.client == client for lease in _concerned(core, []) for use in lease.all_uses())


def _concerned(core: Core, own: list[Lease]) -> list[Lease]:
    """A process's own leases, and all that are in use, perhaps by it, in the order of their
    arrival."""
    used = (
        lease
        for gpu in core.gpus.values()
        for lease in gpu.in_state(LeaseState.HELD, LeaseState.REVOKING)
        if lease.uses or lease.uses.paused
    )
    return sorted(
        {lease.id: lease for lease in (*own, *used)}.values(),
        key=lambda lease: lease.request.arrival,
    )


def on_died(core: Core, event: ProcessDied) -> None:
    """Everything of a process ends. Its bytes become debts, measured gone before they count as
    free."""
    process = event.process
    core.refusals.pop(process, None)
    gone = [client for client in core.clients.values() if client.process == process]
    for client in gone:
        _forget(core, client)
    if gone:
        core.last_client_at = core.now
    for gpu in core.gpus.values():
        account = gpu.ledger.accounts.get(process)
        if account is None:
            continue
        gpu.ledger.bury(process)
        on_process_died(core, gpu, process)
    for lease in _concerned(core, core.leases_of(process)):
        for use in [use for use in lease.all_uses() if use.process == process]:
            end_use(core, lease, use, Why.PROCESS_DIED)
        if lease.process == process:
            _bereave(core, lease)


def _bereave(core: Core, lease: Lease) -> None:
    account_for(core, lease.id)
    died = no.Lost(lease.id, Why.PROCESS_DIED, lease.process.pid)
    if lease.state is LeaseState.QUEUED:
        cancel_waiter(core, lease, Why.PROCESS_DIED)
    elif lease.state in EXPIRING:
        core.note("lost", lease, why=Why.PROCESS_DIED, pid=lease.process.pid)
        lose(core, lease, LeaseState.LOST, died, alive=False)
    else:  # a verification goes on: only the residue is no longer expected
        _give_up(core, lease, LeaseState.LOST, died)


def on_journal_failed(core: Core, event: JournalFailed) -> None:
    """A grant that could not be written was not sent: it is taken back. The executor refuses the
    request whose reply it held back; a waiter that was to hear by push is denied here.

    Other records only make a later recovery more careful; they are worth a note.
    """
    core.note("journal_failed", key=event.key, reason=event.reason)
    lease = core.leases.get(LeaseId(event.key.removeprefix("lease:")))
    if not event.gates or lease is None or lease.state is not LeaseState.LOADING:
        return
    gpu = core.gpu_of(lease)
    gpu.ledger.withdraw(lease.id, core.now)
    core.forget(event.key)
    refusal = no.NotJournaled(lease.id, event.key, event.reason)
    core.move(lease, LeaseState.DENIED, refusal.code)
    if lease.request.id is None:  # else: the session that held the reply back refused it
        core.push(lease, DeniedPush(lease.id, refusal.view()))
    core.note("denied", lease, code=refusal.code, refusal=refusal)
    core.end(lease, refusal)
