#!/usr/bin/env bash
# Make an authority and a certificate for each server: make-certificates.sh FOLDER [NAME...]
# NAME is the host name by which the service reaches a server: postgres and redis in docker-compose.yml.
# A hospital that has an authority of its own uses that one, and only the file names of this script.
set -euo pipefail
folder=$1
shift
if [ $# = 0 ]; then set -- postgres redis; fi
umask 077
mkdir -p "$folder"
cd "$folder"

# The authority lives for two years, a certificate for one.
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 730 -subj "/CN=fluoromap authority" \
  -addext "keyUsage=critical,keyCertSign,cRLSign" -keyout authority.key -out authority.pem 2>/dev/null
for name in "$@"; do
  openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj "/CN=$name" -keyout "$name.key" -out "$name.csr" 2>/dev/null
  printf 'subjectAltName=DNS:%s\nextendedKeyUsage=serverAuth\nbasicConstraints=CA:FALSE\n' "$name" >"$name.ext"
  openssl x509 -req -in "$name.csr" -CA authority.pem -CAkey authority.key -CAcreateserial -days 365 -extfile "$name.ext" \
    -out "$name.pem" 2>/dev/null
  rm "$name.csr" "$name.ext"
done
chmod 0444 ./*.pem
# With the key of the authority one could make a certificate for any server. Keep it elsewhere, or make all anew next time.
rm -f authority.srl
