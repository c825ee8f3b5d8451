"""The paper of Abdulnabi and Esmail (2022) reproduced, and its claims put to the test."""
