// The types of the vendored library; only the check of types reads this file.
export * from "three";
