"""Make a certificate authority, a router's certificate and one for each name: python make_certificates.py --help."""

import argparse
import datetime
import ipaddress
from pathlib import Path

try:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
    from cryptography.x509.oid import NameOID
except ImportError as error:
    raise SystemExit(f"make_certificates.py: {error}: pip install cryptography") from None


def address(host):
    """Return ``host`` as a certificate names it: an IP address or a DNS name."""
    numeric = host.replace(".", "").isdigit() or ":" in host
    return x509.IPAddress(ipaddress.ip_address(host)) if numeric else x509.DNSName(host)


def certificate(name, issuer=None, hosts=()):
    """Return a key and a certificate for ``name``, signed by ``issuer``; without one, an authority's."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now, day = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=1)
    builder = (
        x509.CertificateBuilder(issuer[1].subject if issuer else subject, subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - day)  # a robot's clock may be behind
        .not_valid_after(now + 825 * day)
        .add_extension(x509.BasicConstraints(ca=issuer is None, path_length=None), critical=True)
    )
    if hosts:  # without addresses it cannot stand for a router
        names = x509.SubjectAlternativeName([address(host) for host in hosts])
        builder = builder.add_extension(names, critical=False)
    return key, builder.sign(issuer[0] if issuer else key, hashes.SHA256())


def write(folder, name, pair):
    """Write NAME.pem, the certificate, and NAME.key, which only its owner may read."""
    private, public = folder / f"{name}.key", folder / f"{name}.pem"
    private.touch(mode=0o600)
    private.write_bytes(pair[0].private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public.write_bytes(pair[1].public_bytes(Encoding.PEM))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--router", nargs="+", required=True, metavar="HOST", help="its addresses and names")
    parser.add_argument("--names", nargs="+", required=True, help="robots and nodes")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    authority = certificate("coview authority")
    write(options.folder, "ca", authority)
    write(options.folder, "router", certificate("router", authority, options.router))
    for each in options.names:
        write(options.folder, each, certificate(each, authority))
