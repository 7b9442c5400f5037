#!/usr/bin/env perl
# A client in another language: the arbiter's wire by hand, without a ZeroMQ or msgpack library.
# One msgpack map per ZMTP 3.1 frame (https://rfc.zeromq.org/spec/37/) over the Unix socket.
# A lease that lasts longer than its ttl_s (10 s) also needs `renew`; its holder answers the push
# `revoke` with `revoke_ack`, `unloading` and `release`. All messages: schemas/json/.
use strict;
use warnings;
use IO::Socket::UNIX;

my $VERSION = 3;    # of the wire
my $folder = $ENV{RUNTIME_DIRECTORY} // ($ENV{XDG_RUNTIME_DIR} // '/run') . '/vram-arbiter';
my $path = ($ENV{VRAM_ARBITER_ENDPOINT} // "$folder/arbiter.sock") =~ s{^ipc://}{}r;
my $socket = IO::Socket::UNIX->new(Peer => $path) or die "no arbiter at $path: $!\n";

# -- msgpack: maps, arrays, text, numbers ----------------------------------------------------------
sub encode {
    my ($value) = @_;
    return "\xc0" unless defined $value;
    return pack 'C n a*', 0xde, scalar keys %$value, join '', map { encode($_) } %$value
        if ref $value eq 'HASH';
    return pack 'C n a*', 0xdc, scalar @$value, join '', map { encode($_) } @$value if ref $value;
    return $value =~ /^-?\d+$/ ? pack 'C q>', 0xd3, $value : pack 'C n/a*', 0xda, $value;
}
my %NUMBER = (0xcb => 'd>', 0xcc => 'C', 0xcd => 'n', 0xce => 'N', 0xcf => 'Q>',
    0xd0 => 'c', 0xd1 => 's>', 0xd2 => 'l>', 0xd3 => 'q>');
my %SIZED = (0xd9 => ['C', 's'], 0xda => ['n', 's'], 0xdb => ['N', 's'], 0xdc => ['n', 'a'],
    0xdd => ['N', 'a'], 0xde => ['n', 'm'], 0xdf => ['N', 'm']);
sub decode {
    my ($bytes) = @_;    # a reference: what is read is taken off
    my $take = sub { my $size = length pack $_[0], 0; unpack $_[0], substr $$bytes, 0, $size, '' };
    my $tag = $take->('C');
    return $tag if $tag < 0x80;
    return $tag - 0x100 if $tag >= 0xe0;
    return $take->($NUMBER{$tag}) if $NUMBER{$tag};
    return $tag == 0xc0 ? undef : $tag == 0xc3 if $tag >= 0xc0 && $tag <= 0xc3;
    my ($size, $kind) = $tag < 0x90 ? ($tag & 15, 'm') : $tag < 0xa0 ? ($tag & 15, 'a')
        : $tag < 0xc0 ? ($tag & 31, 's') : ($take->($SIZED{$tag}[0]), $SIZED{$tag}[1]);
    return substr $$bytes, 0, $size, '' if $kind eq 's';
    return [map { decode($bytes) } 1 .. $size] if $kind eq 'a';
    return {map { decode($bytes) } 1 .. 2 * $size};
}

# -- ZMTP: frames of flags, size and body ----------------------------------------------------------
sub get {
    read($socket, my $bytes, $_[0]) == $_[0] or die "the arbiter hung up\n";
    return $bytes;
}
sub put {
    my ($flags, $body) = @_;    # flag 2: a size of eight bytes
    print $socket length $body < 256 ? pack 'C C/a*', $flags, $body : pack 'C Q>/a*', 2, $body;
    $socket->flush;
}
sub message {
    my $flags = ord get(1);
    my $body = get($flags & 2 ? unpack 'Q>', get(8) : ord get(1));
    return $flags & 4 ? {} : decode(\$body);    # flag 4: a command, such as READY
}
print $socket pack 'C x8 C3 a20 x32', 0xff, 0x7f, 3, 1, 'NULL';    # greeting: ZMTP 3.1
put(4, "\x05READY\x0bSocket-Type" . pack 'N/a*', 'DEALER');
get(64);

# -- the life of a lease ---------------------------------------------------------------------------
my ($id, @pushes) = (0);
sub ask {
    my %request = (id => ++$id, @_);
    put(0, encode(\%request));
    while (1) {
        my $reply = message();
        push @pushes, $reply if $reply->{push};
        next unless ($reply->{re} // 0) == $id;
        return $reply if $reply->{ok};
        die "$request{op}: $reply->{error}{code}: $reply->{error}{message}\n";
    }
}
ask(op => 'hello', version => $VERSION, name => 'sorter', instance => "$$-perl");
my %need = (load_peak_bytes => 2e9, steady_bytes => 2e9, residue_bytes => 0);
my %spec = (consumer => 'sorter', model_id => 'sorter', footprint => \%need);
my $answer = ask(op => 'acquire', nonce => "$$-1", spec => \%spec);
while ($answer->{lease}{state} ne 'loading') {    # queued: wait for the push `granted`
    $answer = shift(@pushes) // message();
    die "denied: $answer->{error}{message}\n" if ($answer->{push} // '') eq 'denied';
}
my @lease = map { $_ => $answer->{lease}{$_} } qw(lease_id token);
print "granted $answer->{lease}{lease_id}\n";
ask(op => 'ready', @lease);
ask(op => 'use_begin', @lease, use_id => "$$-use");
print "working\n";
ask(op => 'use_end', @lease, use_id => "$$-use");
ask(op => 'release', @lease);
ask(op => 'bye');
print "released\n";
