# Sourced. Debian packages of another architecture or release, fetched and unpacked without installing anything, from the
# mirror that this machine's apt uses.

debian_mirror() {
  apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | grep -m 1 '/debian/$'
}

unpack_foreign() { # architecture, suite, folder, packages...
  local arch=$1 suite=$2 folder=$3 apt=$3/apt
  shift 3
  mkdir -p "$apt"/{lists/partial,archives/partial,etc}
  echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $(debian_mirror) $suite main" >"$apt/etc/sources.list"
  touch "$apt/status"
  local options=(-qq -o APT::Architecture="$arch" -o APT::Architectures="$arch" -o Dir::State="$apt"
    -o Dir::State::status="$apt/status" -o Dir::State::lists="$apt/lists" -o Dir::Cache="$apt"
    -o Dir::Etc::sourcelist="$apt/etc/sources.list" -o Dir::Etc::sourceparts=- -o APT::Sandbox::User=root)
  apt-get "${options[@]}" update
  (cd "$apt/archives" && apt-get "${options[@]}" download "$@")
  for package in "$apt"/archives/*.deb; do
    dpkg-deb -x "$package" "$folder"
  done
}
